// PX4's own mc_att_control and mc_rate_control, which this module replaces.
#pragma once

namespace mimopilot
{

// Starts or stops both, in a task of its own: a stop waits until they have run once more, on this module's work queue.
void command_stock_controllers(bool run);

// Whether that task is still running.
bool stock_controllers_busy();

}  // namespace mimopilot
