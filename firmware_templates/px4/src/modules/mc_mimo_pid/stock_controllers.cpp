#include "stock_controllers.hpp"

#include <px4_platform_common/atomic.h>
#include <px4_platform_common/tasks.h>
#include <string.h>

// The commands of PX4's shell with these names.
extern "C" int mc_att_control_main(int argc, char *argv[]);
extern "C" int mc_rate_control_main(int argc, char *argv[]);

namespace mimopilot
{

namespace
{

px4::atomic<bool> busy{false};
px4::atomic<StockCommand> wanted{StockCommand::Stop};
bool attitude_started = false;  // alone, before the rate controller

void call(int (&entry)(int, char *[]), const char *what)
{
	char name[] = "stock";
	char argument[8];
	strncpy(argument, what, sizeof(argument));
	char *arguments[] = {name, argument, nullptr};
	entry(2, arguments);
}

// The torque is given up last and taken first, so that the gap without it is the shortest.
int execute(int, char *[])
{
	const StockCommand command = wanted.load();

	if (command == StockCommand::Stop) {
		call(mc_att_control_main, "stop");
		call(mc_rate_control_main, "stop");

	} else {
		if (command == StockCommand::Start) { call(mc_rate_control_main, "start"); }

		if (!attitude_started) { call(mc_att_control_main, "start"); }
	}

	attitude_started = command == StockCommand::StartAttitude;
	busy.store(false);
	return 0;
}

}  // namespace

void command_stock_controllers(StockCommand command)
{
	constexpr int kStack = 2400;  // bytes, as PX4's shell commands have
	wanted.store(command);
	busy.store(true);

	if (px4_task_spawn_cmd("mimo_stock", SCHED_DEFAULT, SCHED_PRIORITY_ATTITUDE_CONTROL, kStack, execute, nullptr) < 0) {
		busy.store(false);

		// Somebody must fly.
		if (command == StockCommand::Start) { execute(0, nullptr); }
	}
}

bool stock_controllers_busy() { return busy.load(); }

}  // namespace mimopilot
