#pragma once

#include <uORB/uORB.h>

namespace uORB {

class PublicationBase
{
public:
	bool advertised() const { return _handle != nullptr; }
	bool unadvertise() { return Manager::orb_unadvertise(_handle) == 0; }

protected:
	explicit PublicationBase(const orb_metadata *meta) : _meta(meta) {}

	~PublicationBase()
	{
		if (_handle != nullptr) { unadvertise(); }
	}

	orb_advert_t _handle{nullptr};
	const orb_metadata *const _meta;
};

template<typename T>
class Publication : public PublicationBase
{
public:
	explicit Publication(const orb_metadata *meta) : PublicationBase(meta) {}

	bool advertise()
	{
		if (!advertised()) { _handle = orb_advertise(_meta, nullptr); }

		return advertised();
	}

	bool publish(const T &data)
	{
		if (!advertised()) { advertise(); }

		return Manager::orb_publish(_meta, _handle, &data) == 0;
	}
};

}  // namespace uORB
