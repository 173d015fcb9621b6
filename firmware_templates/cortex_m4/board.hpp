// What a board gives to main.cpp. The versions there do nothing and never arm; define your own in another file.
#pragma once

#include "../core/mimo_pid.hpp"

// Called once a period, before the step: sensors, set-points, saturation of the allocator, armed and landed.
void read_board(mimopilot::Input &input);

// Called once a period, after the step: moments to the allocator and the motors.
void write_board(const mimopilot::Output &output);
