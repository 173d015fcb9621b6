// Start-up of a Cortex-M4F: vector table, FPU, memory, main. The clock keeps its reset setting.
#include <stdint.h>

#ifdef MIMO_PID_SEMIHOSTING
#include <stdio.h>
#include <unistd.h>
#endif

extern "C" {

// From stm32f4.ld.
extern uint32_t stack_top[];
extern const uint32_t data_load[];
extern uint32_t data_start[];
extern uint32_t data_end[];
extern uint32_t bss_start[];
extern uint32_t bss_end[];

int program(void) __asm__("main");  // ISO C++ forbids calling main by its name

#ifdef MIMO_PID_SEMIHOSTING
void initialise_monitor_handles(void);  // newlib: opens the host's console
#endif

[[noreturn]] void reset(void);
[[noreturn]] void stop(void);
__attribute__((weak)) void system_tick(void);

}  // extern "C"

namespace {

constexpr uintptr_t kCoprocessorAccess = 0xE000ED88U;  // CPACR
constexpr uint32_t kFullAccessToFpu = 0xFU << 20;

using Vector = void (*)();

uintptr_t words(const uint32_t *first, const uint32_t *last)
{
	return (reinterpret_cast<uintptr_t>(last) - reinterpret_cast<uintptr_t>(first)) / sizeof(uint32_t);
}

// Core exceptions only; a board appends its interrupts. A fault loops in stop(), where a debugger sees it.
__attribute__((section(".vectors"), used)) const Vector vectors[] = {
	reinterpret_cast<Vector>(stack_top),
	reset,
	stop,                                    // NMI
	stop,                                    // hard fault
	stop,                                    // memory management
	stop,                                    // bus fault
	stop,                                    // usage fault
	nullptr, nullptr, nullptr, nullptr,
	stop,                                    // SVCall
	stop,                                    // debug monitor
	nullptr,
	stop,                                    // PendSV
	system_tick,
};

}  // namespace

void reset(void)
{
	*reinterpret_cast<volatile uint32_t *>(kCoprocessorAccess) |= kFullAccessToFpu;
	__asm__ volatile("dsb\n\tisb" ::: "memory");

	for (uintptr_t k = 0; k < words(data_start, data_end); k++) { data_start[k] = data_load[k]; }

	for (uintptr_t k = 0; k < words(bss_start, bss_end); k++) { bss_start[k] = 0; }

#ifdef MIMO_PID_SEMIHOSTING
	initialise_monitor_handles();
	const int status = program();
	fflush(nullptr);
	_exit(status);
#else
	program();
	stop();
#endif
}

void stop(void)
{
	for (;;) { __asm__ volatile("wfi"); }
}

void system_tick(void) {}
