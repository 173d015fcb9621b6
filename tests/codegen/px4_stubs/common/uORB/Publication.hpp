#pragma once

#include <string.h>

#include <uORB/uORB.h>

namespace uORB {

template<typename T>
class Publication
{
public:
	explicit Publication(const orb_metadata *meta) : _meta(meta) {}

	~Publication()
	{
		if (_advertised) { node(_meta).advertised = false; }
	}

	bool advertise()
	{
		if (!_advertised) { node(_meta).advertised = true; }

		_advertised = true;
		return true;
	}

	bool publish(const T &data)
	{
		advertise();
		Node &topic = node(_meta);
		topic.message.resize(sizeof(T));
		memcpy(topic.message.data(), &data, sizeof(T));
		topic.generation++;
		return true;
	}

private:
	const orb_metadata *_meta;
	bool _advertised{false};
};

}  // namespace uORB
