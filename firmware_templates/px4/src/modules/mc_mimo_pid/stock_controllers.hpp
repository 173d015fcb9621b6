// PX4's own mc_att_control and mc_rate_control, which this module replaces.
#pragma once

namespace mimopilot
{

// Starts or stops both, or starts mc_att_control alone, in a task of its own: a stop waits until they have run once more,
// on this module's work queue.
enum class StockCommand : char { Stop, Start, StartAttitude };
void command_stock_controllers(StockCommand command);

// Whether that task is still running.
bool stock_controllers_busy();

}  // namespace mimopilot
