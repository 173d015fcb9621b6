// What main.cpp needs of a board. Its weak defaults do nothing and never arm; define yours in another file.
#pragma once

#include "../core/mimo_pid.hpp"

// Called every period before the step: read sensors, setpoints, allocator saturation, armed and landed.
void read_board(mimopilot::Input &input);

// Called every period after the step: pass the torque to allocator and motors.
void write_board(const mimopilot::Output &output);
