/* The table of log variables: one group, readable by the tests. */
#pragma once
#include <stdint.h>

#define LOG_UINT8 1
#define LOG_INT8 4
#define LOG_FLOAT 7

struct log_s {
	uint8_t type;
	const char *name;
	void *address;
};

#define LOG_GROUP_START(NAME) \
	const char *log_group(void); \
	const char *log_group(void) { return #NAME; } \
	extern const struct log_s log_table[]; \
	const struct log_s log_table[] = {
#define LOG_ADD(TYPE, NAME, ADDRESS) {.type = (TYPE), .name = #NAME, .address = (void *)(ADDRESS)},
#define LOG_GROUP_STOP(NAME) {.name = 0}};
