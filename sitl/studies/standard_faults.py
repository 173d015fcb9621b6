"""The standard faults of the fault table."""

from __future__ import annotations

from mimopilot.sitl.faults.kinds import Fault, parse_fault
from mimopilot.sitl.physics.airframe import Airframe

AT = 1.1  # s: time of the faults, 0.1 s after the start of the manoeuvre


def standard_faults(airframe: Airframe) -> tuple[Fault, ...]:
    """The standard faults with their sizes: a vehicle should survive or detect each."""
    x, y, z = (0.8 * place for place in airframe.rotors[2].position)
    load = round(0.11 * airframe.mass, 3)
    tick = "0.001"  # s, shorter than a period: one sample
    texts = (
        *(f"motor:3={share}@{AT}" for share in (0.9, 0.7, 0.5, 0)),
        f"battery=0.8@{AT}+0.5",
        f"mass:{x:.4g},{y:.4g},{z:.4g}={load}@{AT}",
        *(f"delay={size}@{AT}" for size in (0.02, 0.028, 0.036)),
        f"jitter=0.02@{AT}",
        f"loss=0.5@{AT}",
        f"duplicate=0.5@{AT}",
        f"skip=5@{AT}",
        f"clock=0.1@{AT}",
        f"link@{AT}+0.2",
        f"stale@{AT}+1",
        *(f"gyro-stuck@{AT}+{length}" for length in (0.1, 0.2, 0.4)),
        f"gyro-bias:roll=0.2@{AT}",
        f"gyro-noise=0.1@{AT}",
        f"gyro-nan@{AT}+{tick}",
        f"gyro-nan@{AT}+0.2",
        *(f"gain:Kp_i={factor}@{AT}" for factor in (0.25, 0.5, 2, 4)),
    )
    return tuple(map(parse_fault, texts))
