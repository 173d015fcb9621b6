/* The table of parameters: one group, readable by the tests. */
#pragma once
#include <stdint.h>

#define PARAM_UINT8 (0x00 | (0x01 << 3))
#define PARAM_FLOAT (0x02 | (0x01 << 2))
#define PARAM_RONLY (1 << 6)
#define PARAM_PERSISTENT (1 << 8)

struct param_s {
	uint16_t type;
	const char *name;
	void *address;
};

#define PARAM_GROUP_START(NAME) \
	const char *param_group(void); \
	const char *param_group(void) { return #NAME; } \
	extern const struct param_s param_table[]; \
	const struct param_s param_table[] = {
#define PARAM_ADD(TYPE, NAME, ADDRESS) {.type = (TYPE), .name = #NAME, .address = (void *)(ADDRESS)},
#define PARAM_GROUP_STOP(NAME) {.name = 0}};
