import pytest

from sitl.airframe import FOLDER, known_airframes, load_airframe
from sitl.errors import SitlError
from sitl.moment_scale import check_moment_scale


def test_the_airframes_of_the_thesis_come_with_their_gains():
    assert known_airframes() == ["adam0", "adam0_nominal", "adam0_perturbed", "antr"]
    for name in known_airframes():
        vehicle = load_airframe(name)
        assert vehicle.airframe.name == name
        check_moment_scale(vehicle.default_gains(), vehicle.airframe.moment_scale(), name)


def test_an_unknown_airframe_lists_the_known_ones():
    with pytest.raises(SitlError, match=r"unknown airframe 'adam1'.*adam0, adam0_nominal, adam0_perturbed, antr"):
        load_airframe("adam1")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mass = 1.45", "mass = -1", "mass: Input should be greater than 0"),
        ("mass = 1.45", "", "mass: Field required"),
        ("mass = 1.45", "mass = nan", "mass: .*"),
        ("drag = 0.3", "drag = 0.3\ncolour = 'red'", "colour: Extra inputs"),
        ('"ccw"', '"up"', "direction"),
        ("[0.0172, 0.0016, 0.0]", "[0.0172, 0.5, 0.0]", "symmetric"),
        ("mass = 1.45", "mass = = 1", "not an airframe file"),
    ],
)
def test_a_wrong_entry_of_an_airframe_file_is_named(tmp_path, old, new, message):
    path = tmp_path / "mine.toml"
    text = (FOLDER / "adam0.toml").read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(SitlError, match=rf"mine.toml: .*{message}"):
        load_airframe(str(path))


def test_gains_for_another_unit_of_moment_are_refused(gains):
    import dataclasses

    airframe = load_airframe("adam0").airframe
    with pytest.raises(SitlError, match=r"3\.6, 3\.6, 0\.2736 N m per unit, adam0 has 2\.546"):
        other = dataclasses.replace(gains, moment_scale=(3.6, 3.6, 0.2736))
        check_moment_scale(other, airframe.moment_scale(), airframe.name)
    with pytest.raises(SitlError, match="do not say"):
        check_moment_scale(dataclasses.replace(gains, moment_scale=None), airframe.moment_scale(), airframe.name)
