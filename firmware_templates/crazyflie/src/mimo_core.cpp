// The controller, compiled here because Kbuild compiles only what is below the app's folder.
#include "../../core/mimo_pid.cpp"
