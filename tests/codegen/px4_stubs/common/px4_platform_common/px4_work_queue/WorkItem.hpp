#pragma once

namespace px4 {

struct wq_config_t {
	const char *name;
};

namespace wq_configurations {
static constexpr wq_config_t rate_ctrl{"wq:rate_ctrl"};
}

class WorkItem
{
public:
	WorkItem() = delete;
	virtual ~WorkItem() = default;
	virtual void Run() = 0;

protected:
	WorkItem(const char *, const wq_config_t &) {}
};

}  // namespace px4
