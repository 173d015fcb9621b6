#pragma once

struct perf_ctr_header;
typedef struct perf_ctr_header *perf_counter_t;
enum perf_counter_type { PC_COUNT, PC_ELAPSED, PC_INTERVAL };

// Defined by the host program: they do nothing.
extern "C" {
perf_counter_t perf_alloc(enum perf_counter_type type, const char *name);
void perf_free(perf_counter_t handle);
void perf_begin(perf_counter_t handle);
void perf_end(perf_counter_t handle);
void perf_print_counter(perf_counter_t handle);
}
