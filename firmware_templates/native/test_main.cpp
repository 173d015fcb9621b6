// Runs the test vectors through the controller and compares every bit. Returns 0 if all are equal.
#include <stdio.h>
#include <string.h>

#include "../core/gains.hpp"
#include "test_vectors.hpp"

int main()
{
	static_assert(sizeof(kVectorInputs[0]) == sizeof(mimopilot::Input), "vectors do not fit the interface");
	static_assert(sizeof(kVectorOutputs[0]) == sizeof(mimopilot::Output), "vectors do not fit the interface");

	mimopilot::State state;

	if (!mimopilot::initialise(state, mimopilot::kGains)) {
		printf("the controller refused its own gains\n");
		return 1;
	}

	int different = 0;

	for (int k = 0; k < kVectors; k++) {
		mimopilot::Input input;
		mimopilot::Output output;
		memcpy(&input, kVectorInputs[k], sizeof(input));
		mimopilot::step(state, input, output);

		if (memcmp(&output, kVectorOutputs[k], sizeof(output)) != 0) {
			if (different == 0) { printf("row %d differs\n", k); }

			different++;
		}
	}

	printf("%d of %d rows differ\n", different, kVectors);
	return different == 0 ? 0 : 1;
}
