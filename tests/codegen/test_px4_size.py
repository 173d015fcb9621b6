"""Flash of the emitted PX4 module on a Cortex-M4F, compiled with stubs of PX4 and the module's and PX4's flags."""

import pytest

from mimopilot.codegen.toolchain import CORTEX_M4_FLAGS, cross_tool, run_tool
from tests.codegen.px4_host import CORE_FLAGS, PX4_FLAGS, STANDARD, emit

#: Bytes of code and constants of the module without the core, and of both. The first module, with less to do, had
#: 15,600 in a build of px4_fmu-v3.
LARGEST, LARGEST_WITH_CORE = 12_500, 15_600
#: As in the module's CMakeLists.txt and in PX4's flags for NuttX.
FLAGS = ("-Os", "-fno-threadsafe-statics", "-ffunction-sections", "-fdata-sections", "-fomit-frame-pointer")


@pytest.mark.parametrize("api", STANDARD)
def test_the_code_of_the_module_fits(gains, api, tmp_path, record_property):
    sources, includes = emit(gains, api, tmp_path)
    sizes = {}
    for source in sources:
        own = CORE_FLAGS if source.stem == "mimo_pid" else ()
        flags = [STANDARD[api], *PX4_FLAGS, *CORTEX_M4_FLAGS, *FLAGS, *own, *includes]
        part = tmp_path / f"{source.stem}.o"
        run_tool([cross_tool("g++"), *flags, "-c", source, "-o", part])
        text, data, _ = map(int, run_tool([cross_tool("size"), part]).splitlines()[1].split()[:3])
        sizes[source.stem] = text + data
    report = ", ".join(f"{name} {size}" for name, size in sorted(sizes.items(), key=lambda item: -item[1]))
    total = sum(sizes.values())
    record_property("bytes", report)
    assert total - sizes["mimo_pid"] <= LARGEST and total <= LARGEST_WITH_CORE, f"{total} bytes: {report}"
