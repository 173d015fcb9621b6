/* Stand-in for the firmware's console. */
#pragma once
int consolePrintf(const char *format, ...);
#define DEBUG_PRINT(...) consolePrintf(__VA_ARGS__)
