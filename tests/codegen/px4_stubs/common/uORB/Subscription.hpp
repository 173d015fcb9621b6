#pragma once

#include <string.h>

#include <uORB/uORB.h>

namespace uORB {

class Subscription
{
public:
	Subscription(const orb_metadata *meta, uint8_t = 0) : _meta(meta) {}

	bool advertised() { return node(_meta).advertised; }
	bool updated() { return advertised() && node(_meta).generation != _last_generation; }
	bool update(void *dst) { return updated() && copy(dst); }

	bool copy(void *dst)
	{
		Node &topic = node(_meta);

		if (topic.message.empty()) { return false; }

		memcpy(dst, topic.message.data(), topic.message.size());
		_last_generation = topic.generation;
		return true;
	}

	unsigned get_last_generation() const { return _last_generation; }

private:
	const orb_metadata *_meta;
	unsigned _last_generation{0};
};

}  // namespace uORB
