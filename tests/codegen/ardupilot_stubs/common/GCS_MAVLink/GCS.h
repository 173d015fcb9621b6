#pragma once

#include <stdio.h>

enum { MAV_SEVERITY_CRITICAL = 2, MAV_SEVERITY_WARNING = 4, MAV_SEVERITY_INFO = 6 };

#define GCS_SEND_TEXT(severity, format, args...) printf("text " format "\n", ##args)
