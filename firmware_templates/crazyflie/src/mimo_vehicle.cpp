// The parts that all vehicles share, compiled here because Kbuild compiles only what is below the app's folder.
#include "../../vehicle/attitude.cpp"
#include "../../vehicle/excitation.cpp"
