#pragma once
#include <stdint.h>

#define M2T(X) ((unsigned int)(X))
