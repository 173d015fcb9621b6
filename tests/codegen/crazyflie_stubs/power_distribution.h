#pragma once

float powerDistributionGetMaxThrust();
