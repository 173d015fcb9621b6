// PX4 up to v1.17.
#pragma once

#include <string.h>

#include <px4_platform_common/atomic.h>
#include <px4_platform_common/defines.h>
#include <px4_platform_common/log.h>
#include <px4_platform_common/module_usage.h>

template<class T>
class ModuleBase
{
public:
	virtual ~ModuleBase() = default;

	static int main(int argc, char *argv[])
	{
		if (argc > 1 && strcmp(argv[1], "start") == 0) { return is_running() ? -1 : T::task_spawn(argc - 1, argv + 1); }

		T *const object = _object.load();

		if (argc > 1 && strcmp(argv[1], "status") == 0) { return object != nullptr ? object->print_status() : -1; }

		if (argc > 1 && strcmp(argv[1], "stop") == 0) {
			if (object != nullptr) { object->request_stop(); }

			return 0;
		}

		return T::custom_command(argc - 1, argv + 1);
	}

	virtual int print_status() { return 0; }
	static bool is_running() { return _task_id != -1; }

protected:
	virtual void request_stop() { _should_exit = true; }
	bool should_exit() const { return _should_exit; }

	static void exit_and_cleanup()
	{
		delete _object.load();
		_object.store(nullptr);
		_task_id = -1;
	}

	static px4::atomic<T *> _object;
	static int _task_id;
	static constexpr const int task_id_is_work_queue = -2;

private:
	bool _should_exit{false};
};

template<class T>
px4::atomic<T *> ModuleBase<T>::_object{nullptr};

template<class T>
int ModuleBase<T>::_task_id = -1;
