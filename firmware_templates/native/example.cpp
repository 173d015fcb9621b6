// Runs ten control periods with a level setpoint and the vehicle rolled by 0.1 rad.
#include <stdio.h>

#include "../core/gains.hpp"

int main()
{
	mimopilot::State state;

	if (!mimopilot::initialise(state, mimopilot::kGains)) { return 1; }

	mimopilot::Input input = {};
	input.attitude[0] = 0.1F;
	input.armed = 1;

	for (int k = 0; k < 10; k++) {
		mimopilot::Output output;
		mimopilot::step(state, input, output);
		printf("%d  roll %+.6f  pitch %+.6f  yaw %+.6f\n", k, static_cast<double>(output.moment[0]),
		       static_cast<double>(output.moment[1]), static_cast<double>(output.moment[2]));
	}

	return 0;
}
