"""A scripted flying vehicle with an injector: it streams its flight state, and events change it."""

from mimopilot.sitl.autopilot.excitation_injector import AXIS, Conditions, Injector
from mimopilot.sitl.mavlink.ground_station.events import (
    AttitudeReport,
    Heartbeat,
    InjectorState,
    LandedState,
    ParameterValue,
    SetMessageInterval,
    StatusText,
)
from mimopilot.tuning.parameters import EXCITATION
from tests.sitl.mavlink.scripted_vehicle import ScriptedVehicle

HOLD = 4 << 16 | 3 << 24
TS = 0.02


class FlyingVehicle(ScriptedVehicle):
    """Hovers. `integers`: integer parameters are INT32, as on PX4; `then`: time (s) -> event; `careless`: its own
    injector never stops by itself."""

    def __init__(self, integers=False, then=None, careless=False, **values):
        names = {setting.name: setting.default for setting in EXCITATION}
        super().__init__({**names, "MIMO_TS": 0.004, **values})
        self.whole = {setting.name for setting in EXCITATION if setting.integer} if integers else set()
        self.then, self.careless = dict(then or {}), careless
        self.injector = Injector(TS)
        self.injector.configure(dict(self.values))
        self.armed, self.mode, self.tilt, self.landed = True, HOLD, 0.02, 2
        self.silent, self.stepped = set(), 0.0
        self.moments = []
        self.asked = set()

    def heartbeat(self):
        return [] if "HEARTBEAT" in self.silent else [Heartbeat(1, 1, 12 if self.whole else 0, self.armed, self.mode)]

    def value(self, name):
        return ParameterValue(1, 1, name, self.values[name], 6 if name in self.whole else 9)

    def store(self, name, value):
        answer = super().store(name, value)
        self.injector.configure({n: v for n, v in self.values.items() if n.startswith("MIMO_EX")})
        return answer

    def answer(self, order):
        if isinstance(order, SetMessageInterval):
            self.asked.add(order.message)
            return []
        return super().answer(order)

    def stream(self, now):
        """Messages that it streams, at 10 Hz."""
        for at in [at for at in self.then if at <= now]:
            self.then.pop(at)(self)
        while self.stepped < now:
            self.stepped += TS
            mode = 4 if self.mode == HOLD else 2
            conditions = Conditions(self.armed and self.landed == 2, mode, (self.tilt, 0.0), (0.0,) * 4)
            hover = Conditions(True, 4, (0.0, 0.0), (0.0,) * 4)
            self.moments.append(self.injector.step(hover if self.careless else conditions))
        said = [StatusText(1, 1, text) for text in self.injector.said]
        self.injector.said.clear()
        streamed = {
            30: AttitudeReport(1, 1, self.tilt, 0.0),
            250: InjectorState(1, 1, self.injector.phase.published, round(1e6 * now)),
            245: LandedState(1, 1, self.landed),
        }
        return said + [message for number, message in streamed.items() if number in self.asked - self.silent]

    @property
    def exciting(self):
        return self.injector.running

    @property
    def settings(self):
        """Its parameters, except the one that starts the injector."""
        return {name: value for name, value in self.values.items() if name != AXIS}
