#pragma once

// Defined by the host program: the task runs when the caller has returned.
#define SCHED_DEFAULT 0
#define SCHED_PRIORITY_ATTITUDE_CONTROL 0

typedef int (*px4_main_t)(int argc, char *argv[]);
int px4_task_spawn_cmd(const char *name, int scheduler, int priority, int stack, px4_main_t entry, char *const argv[]);
