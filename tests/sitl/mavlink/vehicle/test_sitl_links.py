"""`mimopilot sitl` with a signing key, with a parameter file, and with several ground stations."""

import numpy as np
from pymavlink import mavutil

from tests.conftest import assert_one_clear_line
from tests.sitl.mavlink.running import PATIENCE_S, Pilot, free_port, running_sitl

KEY = bytes(range(32))


def test_a_vehicle_with_a_key_obeys_only_stations_with_the_key(tmp_path, mimopilot):
    key = tmp_path / "key"
    key.write_bytes(KEY)
    with running_sitl("--signing-key", key) as sitl:
        assert ", signed" in sitl.output
        link = ("params", "--connect", f"tcp:127.0.0.1:{sitl.tcp}", "--timeout", 60)
        done = mimopilot(*link, "--signing-key", key)
        assert (done.returncode, "MIMO_RP_RR" in done.stdout) == (0, True), done.stderr
        unsigned = mimopilot(*link, "--timeout", 3)
        assert_one_clear_line(unsigned, "no answer", "give --signing-key", code=1)
        # pymavlink's own signing, as MAVProxy uses it.
        other = mavutil.mavlink_connection(f"udpin:127.0.0.1:{sitl.udp}", dialect="common", source_system=254)
        # The first heartbeat tells it the protocol version, and makes it drop a key set before.
        other.wait_heartbeat(timeout=PATIENCE_S)
        other.setup_signing(KEY, sign_outgoing=True)
        assert other.wait_heartbeat(timeout=PATIENCE_S).get_signed()
        other.mav.param_set_send(1, 1, b"MIMO_RP_RR", 0.125, 9)
        assert other.recv_match(type="PARAM_VALUE", blocking=True, timeout=PATIENCE_S).param_value == 0.125
        other.close()


def test_a_parameter_set_by_a_station_survives_a_kill_and_overrides_the_gains(tmp_path, mimopilot):
    kept = tmp_path / "vehicle.params"
    with running_sitl("--parameters", kept) as sitl:
        pilot = Pilot(f"udpin:127.0.0.1:{sitl.udp}")
        pilot.link.mav.param_set_send(1, 1, b"MIMO_RP_RR", 0.125, 9)
        assert pilot.asks("PARAM_VALUE").param_value == 0.125
        pilot.link.mav.command_long_send(1, 1, 245, 0, 1, *[0] * 6)
        assert pilot.asks("COMMAND_ACK").result == 0
        sitl.process.kill()
        pilot.close()
    with running_sitl("--parameters", kept) as sitl:
        assert f"{kept}: 1 parameter overrides the gains: MIMO_RP_RR 0.125 (else 0.15)" in sitl.output
        pilot = Pilot(f"tcp:127.0.0.1:{sitl.tcp}")
        pilot.link.mav.param_request_read_send(1, 1, b"MIMO_RP_RR", -1)
        assert pilot.asks("PARAM_VALUE").param_value == 0.125
        pilot.close()
    kept.write_text(kept.read_text().replace("0.125", "1e9"))
    refused = mimopilot("sitl", "adam0", "--parameters", kept, "--tcp-port", 0, "--vehicle-port", 0)
    assert_one_clear_line(refused, str(kept), "MIMO_RP_RR", "expected 0.0001 to 5")


def test_two_stations_by_udp_and_tcp_see_each_others_changes_and_only_their_own_answers():
    with running_sitl() as sitl:
        first, second = Pilot(f"udpin:127.0.0.1:{sitl.udp}"), Pilot(f"tcp:127.0.0.1:{sitl.tcp}")
        first.link.mav.param_set_send(1, 1, b"MIMO_RP_RR", 0.125, 9)
        assert first.asks("PARAM_VALUE").param_value == 0.125
        assert second.asks("PARAM_VALUE").param_value == 0.125
        second.link.mav.param_request_read_send(1, 1, b"MIMO_TS", -1)
        assert second.asks("PARAM_VALUE").param_value == np.float32(0.004)
        first.link.mav.param_request_read_send(1, 1, b"MIMO_RP_RR", -1)
        assert first.asks("PARAM_VALUE").param_id == "MIMO_RP_RR"  # it did not receive the other's answer
        assert second.link.packet_loss() == 0.0
        assert first.link.packet_loss() == 0.0
        for pilot in (first, second):
            pilot.link.mav.param_request_list_send(1, 1)
        for pilot in (first, second):
            assert {pilot.asks("PARAM_VALUE").param_index for _ in range(48)} == set(range(48))
        first.close()
        second.close()


def test_an_address_or_port_that_cannot_be_bound_is_one_clear_error(mimopilot):
    ports = ("--ground-port", free_port(), "--vehicle-port", 0, "--tcp-port", 0)
    assert_one_clear_line(mimopilot("sitl", "adam0", *ports, "--bind", "192.0.2.1"), "192.0.2.1")
    assert_one_clear_line(mimopilot("sitl", "adam0", *ports, "--bind", "no such host"), "no such host")
    assert_one_clear_line(mimopilot("experiment", "adam0"), "--out")
    assert_one_clear_line(mimopilot("experiment", "--connect", "udpin:127.0.0.1:1", "--out", "x"), "--out")
    assert_one_clear_line(mimopilot("experiment", "--connect", "udpin:127.0.0.1:1"), "--yes")
