"""The emitted PX4 module, compiled once for both PX4 interfaces."""

import pytest

from tests.codegen.px4_host import STANDARD, build


@pytest.fixture(scope="session")
def programs(tmp_path_factory):
    from tests.conftest import gains

    return {api: build(gains.__wrapped__(), api, tmp_path_factory.mktemp(api)) for api in STANDARD}


@pytest.fixture(scope="session", params=STANDARD)
def program(request, programs):
    return programs[request.param]
