"""Names and bits of PX4's parameters around an experiment, v1.14 to v1.17: its log's profile and its autotune."""

from __future__ import annotations

LOG_PROFILE = "SDLOG_PROFILE"
#: Its bits for the default topics, for every sample of the controllers, and for debug topics.
DEFAULT_TOPICS, HIGH_RATE, DEBUG_TOPICS = 1, 16, 32
#: Profile of a log that gains are tuned from.
TUNING_PROFILE = DEFAULT_TOPICS | HIGH_RATE | DEBUG_TOPICS
#: The autotune starts at boot; runs; applies its gains; its amplitude, rad/s; its design's rise time, s.
AUTOTUNE_ENABLE, AUTOTUNE_START, AUTOTUNE_APPLY = "MC_AT_EN", "MC_AT_START", "MC_AT_APPLY"
AUTOTUNE_AMPLITUDE, AUTOTUNE_RISE_TIME = "MC_AT_SYSID_AMP", "MC_AT_RISE_TIME"
#: What the names of all its parameters begin with.
AUTOTUNE_PREFIX = "MC_AT_"
