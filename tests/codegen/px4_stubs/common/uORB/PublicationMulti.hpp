#pragma once

#include <uORB/Publication.hpp>

namespace uORB {

template<typename T>
class PublicationMulti : public Publication<T>
{
public:
	using Publication<T>::Publication;
};

}  // namespace uORB
