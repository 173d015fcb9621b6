#pragma once

#include <uORB/uORB.h>

#define _MSG_PRIO_WARNING 4

// Defined by the host program.
extern "C" void mavlink_vasprintf(int severity, orb_advert_t *publication, const char *format, ...)
	__attribute__((format(printf, 3, 4)));
