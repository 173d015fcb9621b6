// A topic that another module publishes while this one does not.
#pragma once

namespace mimopilot
{

// P: uORB::Publication or uORB::PublicationMulti. PX4 marks a topic as not advertised as soon as one of its publishers
// stops, also for all others.
template<typename P>
class Topic : public P
{
public:
	using P::P;

	// This module publishes from now on.
	void take()
	{
		this->_handle = nullptr;
		this->advertise();
	}

	// Another module will publish: nobody may be told that the topic has ended.
	void leave() { this->_handle = nullptr; }

	// Nobody publishes.
	void end()
	{
		if (this->_handle != nullptr) { this->unadvertise(); }

		leave();
	}
};

}  // namespace mimopilot
