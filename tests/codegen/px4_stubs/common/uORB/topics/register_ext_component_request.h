#pragma once
#include <uORB/uORB.h>

struct register_ext_component_request_s {
	uint64_t timestamp;
	uint64_t request_id;
	uint16_t px4_ros2_api_version;
	char name[25];
	bool register_arming_check;
	static constexpr uint16_t LATEST_PX4_ROS2_API_VERSION = 1;
};
ORB_DECLARE(register_ext_component_request);
