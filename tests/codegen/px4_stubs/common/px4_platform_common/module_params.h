#pragma once

#include <stdint.h>

#include <vector>

// The test generates it from module.yaml, as PX4's build does: enum px4::params, its types, APPLY_ALL.
#include "generated_parameters.hpp"

class ModuleParams
{
public:
	explicit ModuleParams(ModuleParams *parent)
	{
		if (parent != nullptr) { parent->_children.push_back(this); }
	}

	virtual ~ModuleParams() = default;
	ModuleParams(const ModuleParams &) = delete;
	ModuleParams &operator=(const ModuleParams &) = delete;

protected:
	virtual void updateParams()
	{
		for (ModuleParams *child : _children) { child->updateParams(); }

		updateParamsImpl();
	}

	virtual void updateParamsImpl() {}

private:
	std::vector<ModuleParams *> _children;
};

template<px4::params p>
class ParamFloat
{
	static_assert(px4::is_float(p), "not a float parameter");

public:
	float get() const { return _value; }
	void update() { _value = static_cast<float>(px4::values()[static_cast<int>(p)]); }

private:
	float _value{static_cast<float>(px4::values()[static_cast<int>(p)])};
};

template<px4::params p>
class ParamInt
{
	static_assert(!px4::is_float(p), "not an int32 parameter");

public:
	int32_t get() const { return _value; }
	void update() { _value = static_cast<int32_t>(px4::values()[static_cast<int>(p)]); }

private:
	int32_t _value{static_cast<int32_t>(px4::values()[static_cast<int>(p)])};
};

#define STUB_TYPE(...) __VA_ARGS__
#define STUB_SKIP(...)
#define STUB_DECLARE(pair) STUB_TYPE pair;
#define STUB_UPDATE(pair) STUB_SKIP pair.update();
#define DEFINE_PARAMETERS(...) \
	APPLY_ALL(STUB_DECLARE, __VA_ARGS__) \
protected: \
	void updateParamsImpl() final { APPLY_ALL(STUB_UPDATE, __VA_ARGS__) } \
private:
