// Runs ten control periods with a level setpoint and the vehicle rolled by 0.1 rad.
#include <stdio.h>

#include "../core/gains.hpp"

int main()
{
	mimopilot::State state;

	if (!mimopilot::initialise(state, mimopilot::kGains)) { return 1; }

	mimopilot::Input input = {};
	input.attitude_setpoint[0] = 1.0F;
	input.attitude[0] = 0.99875026F;  // cosine and sine of 0.05 rad
	input.attitude[1] = 0.04997917F;
	input.armed = 1;

	for (int k = 0; k < 10; k++) {
		mimopilot::Output output;
		mimopilot::step(state, input, output);
		printf("%d  roll %+.6f  pitch %+.6f  yaw %+.6f\n", k, static_cast<double>(output.moment[0]),
		       static_cast<double>(output.moment[1]), static_cast<double>(output.moment[2]));
	}

	return 0;
}
