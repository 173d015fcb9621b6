// Whether this vehicle is one that the module flies.
#pragma once

namespace mimopilot {

// Null, or why not: a VTOL or no rotary wing, or PX4's autotune is switched on.
const char *not_flown();

}  // namespace mimopilot
