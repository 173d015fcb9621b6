#include "stock_controllers.hpp"

#include <px4_platform_common/atomic.h>
#include <px4_platform_common/tasks.h>

// The commands of PX4's shell with these names.
extern "C" int mc_att_control_main(int argc, char *argv[]);
extern "C" int mc_rate_control_main(int argc, char *argv[]);

namespace mimopilot
{

namespace
{

px4::atomic<bool> busy{false};
char start[] = "start";
char stop[] = "stop";

// The torque is given up last and taken first, so that the gap without it is the shortest.
int command(int argc, char *argv[])
{
	const bool run = argc > 1 && argv[1][2] == 'a';  // start, not stop
	char name[] = "stock";
	char *arguments[] = {name, run ? start : stop, nullptr};
	(run ? mc_rate_control_main : mc_att_control_main)(2, arguments);
	(run ? mc_att_control_main : mc_rate_control_main)(2, arguments);
	busy.store(false);
	return 0;
}

}  // namespace

void command_stock_controllers(bool run)
{
	constexpr int kStack = 2400;  // bytes, as PX4's shell commands have
	char *arguments[] = {run ? start : stop, nullptr};
	busy.store(true);

	if (px4_task_spawn_cmd("mimo_stock", SCHED_DEFAULT, SCHED_PRIORITY_ATTITUDE_CONTROL, kStack, command, arguments) < 0) {
		busy.store(false);

		// Somebody must fly.
		if (run) {
			char name[] = "mimo_stock";
			char *here[] = {name, start, nullptr};
			command(2, here);
		}
	}
}

bool stock_controllers_busy() { return busy.load(); }

}  // namespace mimopilot
