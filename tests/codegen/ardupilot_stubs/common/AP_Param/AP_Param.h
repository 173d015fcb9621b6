// Parameters: names, defaults and values, as ArduPilot's table has them.
#pragma once

#include <map>
#include <stdint.h>
#include <string>

class AP_Float
{
public:
    float get() const { return _value; }
    void set(float value) { _value = value; }

private:
    float _value;
};

class AP_Param
{
public:
    struct GroupInfo {
        const char *name;
        uint8_t idx;
        float default_value;
        intptr_t offset;
    };

    // The stub keeps the object for the test, which sets its parameters by name.
    static void setup_object_defaults(void *object, const GroupInfo *info)
    {
        held() = object;
        table() = info;
        for (const GroupInfo *one = info; one->name != nullptr; one++) { at(*one).set(one->default_value); }
    }

    static AP_Float &at(const GroupInfo &one)
    {
        return *reinterpret_cast<AP_Float *>(static_cast<char *>(held()) + one.offset);
    }

    static bool get(const char *name, float &value)
    {
        const auto found = others().find(name);
        if (found == others().end()) { return false; }
        value = found->second;
        return true;
    }

    static std::map<std::string, float> &others()
    {
        static std::map<std::string, float> values;
        return values;
    }

    static void *&held()
    {
        static void *object;
        return object;
    }

    static const GroupInfo *&table()
    {
        static const GroupInfo *info;
        return info;
    }
};

#define AP_GROUPINFO(name, idx, clazz, element, def) \
    { name, idx, def, reinterpret_cast<intptr_t>(&reinterpret_cast<const clazz *>(1)->element) - 1 }
#define AP_GROUPEND { nullptr, 0, 0, 0 }
