// PX4 after v1.17.
#pragma once

#include <string.h>

#include <px4_platform_common/atomic.h>
#include <px4_platform_common/defines.h>
#include <px4_platform_common/log.h>
#include <px4_platform_common/module_usage.h>

class ModuleBase
{
public:
	struct Descriptor {
		Descriptor(int (*spawn)(int, char **), int (*command)(int, char **), int (*usage)(const char *)) :
			task_spawn(spawn), custom_command(command), print_usage(usage) {}

		int (*task_spawn)(int, char **);
		int (*custom_command)(int, char **);
		int (*print_usage)(const char *);
		px4::atomic<ModuleBase *> object{nullptr};
		int task_id{-1};
	};

	virtual ~ModuleBase() = default;

	static int main(Descriptor &desc, int argc, char *argv[])
	{
		if (argc > 1 && strcmp(argv[1], "start") == 0) {
			return is_running(desc) ? -1 : desc.task_spawn(argc - 1, argv + 1);
		}

		ModuleBase *const object = desc.object.load();

		if (argc > 1 && strcmp(argv[1], "status") == 0) { return object != nullptr ? object->print_status() : -1; }

		if (argc > 1 && strcmp(argv[1], "stop") == 0) {
			if (object != nullptr) { object->request_stop(); }

			return 0;
		}

		return desc.custom_command(argc - 1, argv + 1);
	}

	virtual int print_status() { return 0; }
	static bool is_running(const Descriptor &desc) { return desc.task_id != -1; }

protected:
	virtual void request_stop() { _should_exit = true; }
	bool should_exit() const { return _should_exit; }

	static void exit_and_cleanup(Descriptor &desc)
	{
		delete desc.object.load();
		desc.object.store(nullptr);
		desc.task_id = -1;
	}

	static constexpr const int task_id_is_work_queue = -2;

private:
	bool _should_exit{false};
};
