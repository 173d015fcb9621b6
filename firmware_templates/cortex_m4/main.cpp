// The controller on a bare Cortex-M4F: one step per period, timed by SysTick.
#include <stdint.h>

#include "../core/gains.hpp"
#include "board.hpp"

namespace {

constexpr float kCoreClock = 16.0e6F;  // Hz; after reset an STM32F4 runs on this oscillator
constexpr uint32_t kReload = static_cast<uint32_t>(mimopilot::kGains.period * kCoreClock + 0.5F) - 1U;
static_assert(kReload < (1U << 24), "SysTick has 24 bits: lower the clock");

volatile uint32_t periods = 0;

void start_system_tick()
{
	volatile uint32_t *const system_tick = reinterpret_cast<volatile uint32_t *>(0xE000E010U);
	system_tick[1] = kReload;
	system_tick[2] = 0;
	system_tick[0] = 7;  // core clock, interrupt, enable
}

}  // namespace

extern "C" void system_tick(void) { periods = periods + 1U; }

__attribute__((weak)) void read_board(mimopilot::Input & /*input*/) {}
__attribute__((weak)) void write_board(const mimopilot::Output & /*output*/) {}

int main()
{
	mimopilot::State state;
	mimopilot::Input input = {};
	mimopilot::Output output;
	input.attitude_setpoint[0] = input.attitude[0] = 1.0F;

	if (!mimopilot::initialise(state, mimopilot::kGains)) { return 1; }

	start_system_tick();

	for (uint32_t done = 0;; done++) {
		while (done == periods) { __asm__ volatile("wfi"); }

		read_board(input);
		mimopilot::step(state, input, output);
		write_board(output);
	}
}
