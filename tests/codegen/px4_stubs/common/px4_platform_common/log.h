#pragma once

// Defined by the host program, because tests check the module's messages.
extern "C" void px4_log(const char *level, const char *format, ...) __attribute__((format(printf, 2, 3)));

#define PX4_INFO(...) px4_log("INFO", __VA_ARGS__)
#define PX4_INFO_RAW(...) px4_log("RAW", __VA_ARGS__)
#define PX4_WARN(...) px4_log("WARN", __VA_ARGS__)
#define PX4_ERR(...) px4_log("ERROR", __VA_ARGS__)
