/* C interface of the controller, for host programs and foreign-function callers.
 *
 * Structures are passed as plain bytes, laid out as in core/mimo_pid.hpp. A caller first checks the
 * layout with mimo_pid_interface_hash() and mimo_pid_layout(). */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Selects what mimo_pid_layout() returns. */
enum mimo_pid_layout_item {
	MIMO_PID_SIZEOF_GAINS,
	MIMO_PID_SIZEOF_INPUT,
	MIMO_PID_SIZEOF_OUTPUT,
	MIMO_PID_SIZEOF_STATE,
	MIMO_PID_OFFSET_INPUT_RATES,
	MIMO_PID_OFFSET_INPUT_SATURATION,
	MIMO_PID_OFFSET_INPUT_LANDED,
	MIMO_PID_OFFSET_OUTPUT_FAULT,
	MIMO_PID_OFFSET_STATE_INTEGRAL,
	MIMO_PID_LAYOUT_ITEMS
};

/* First 32 bits of the SHA-256 of this header, of core/mimo_pid.hpp and of the members of Gains. */
uint32_t mimo_pid_interface_hash(void);

/* Size or offset in bytes; -1 for an unknown item. */
int32_t mimo_pid_layout(int32_t item);

/* The gains that this library was generated with. */
void mimo_pid_default_gains(float *gains);

/* Return 1, or 0 if the gains are refused. See core/mimo_pid.hpp. */
int32_t mimo_pid_initialise(uint8_t *state, const float *gains);
int32_t mimo_pid_set_gains(uint8_t *state, const float *gains);

/* One control period; `count` control periods over consecutive inputs and outputs. */
void mimo_pid_step(uint8_t *state, const uint8_t *input, uint8_t *output);
void mimo_pid_run(uint8_t *state, const uint8_t *inputs, uint8_t *outputs, int32_t count);

#ifdef __cplusplus
}
#endif
