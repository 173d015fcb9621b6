// Steps the controller once per row of inputs.bin and writes outputs.bin; a row is the structure's bytes.
// Uses semihosting: run it in an emulator, or on a board with a debugger.
#include <stdio.h>

#include "../core/gains.hpp"

int main()
{
	mimopilot::State state;

	if (!mimopilot::initialise(state, mimopilot::kGains)) { return 1; }

	FILE *const inputs = fopen("inputs.bin", "rb");

	if (inputs == nullptr) { return 1; }

	FILE *const outputs = fopen("outputs.bin", "wb");

	if (outputs == nullptr) {
		fclose(inputs);
		return 1;
	}

	mimopilot::Input input;
	mimopilot::Output output;
	bool written = true;

	while (fread(&input, sizeof(input), 1, inputs) == 1) {
		mimopilot::step(state, input, output);
		written = fwrite(&output, sizeof(output), 1, outputs) == 1 && written;
	}

	fclose(inputs);
	return fclose(outputs) == 0 && written ? 0 : 1;
}
