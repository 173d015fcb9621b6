// The last message, as the test prints it.
#pragma once

#include <stdarg.h>
#include <stdint.h>
#include <string.h>

class AP_Logger
{
public:
    void WriteStreaming(const char *name, const char *labels, const char *units, const char *mults, const char *format, ...)
    {
        valid = strlen(name) <= 4 && strlen(labels) <= 64 && strlen(format) <= 16 && strlen(units) == strlen(format)
                && strlen(mults) == strlen(format);
        va_list arguments;
        va_start(arguments, format);
        for (int i = 0; format[i] != 0; i++) {
            if (format[i] == 'Q') {
                values[i] = static_cast<double>(va_arg(arguments, uint64_t));
            } else if (format[i] == 'b' || format[i] == 'H') {
                values[i] = va_arg(arguments, int);
            } else {
                values[i] = va_arg(arguments, double);
            }
        }
        va_end(arguments);
    }

    bool valid = false;
    double values[16] = {};
};

namespace AP
{
inline AP_Logger &logger()
{
    static AP_Logger one;
    return one;
}
}
