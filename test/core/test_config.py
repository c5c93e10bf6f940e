"""Settings: one source, refusals in words, and a round trip through YAML and ROS files."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.core.config import (
    describe,
    dump_yaml,
    flatten,
    from_mapping,
    get,
    group,
    load_yaml,
    setting,
    settings_of,
    with_overrides,
)
from thermal_stereo_vo.core.errors import ConfigError
from thermal_stereo_vo.pipeline import Config


@dataclass(frozen=True)
class Lamp:
    """A group."""

    power: float = setting(5.0, "How bright.", unit="W", minimum=0.0, maximum=100.0)
    lit: bool = setting(False, "Lit or not.")
    fade_s: float | None = setting(None, "Fade time; empty is instant.", unit="s", minimum=0.0)


@dataclass(frozen=True)
class House:
    """Settings for these tests."""

    floors: int = setting(2, "Storeys.", minimum=1, maximum=9)
    colour: str = setting("red", "Paint.", choices=("red", "green"))
    name: str = setting("home", "Any text.")
    rooms: tuple[float, ...] = setting((1.0, 2.5), "Areas.", unit="m^2")
    lamp: Lamp = group(Lamp, "The lamp.")


def test_declared_settings_are_listed_in_order_with_all_that_is_known():
    infos = {info.path: info for info in settings_of(House)}
    assert list(infos) == ["floors", "colour", "name", "rooms", "lamp.power", "lamp.lit",
                           "lamp.fade_s"]  # fmt: skip
    assert infos["lamp.power"].unit == "W"
    assert infos["lamp.fade_s"].optional
    assert infos["lamp.fade_s"].kind is float
    assert infos["rooms"].kind is tuple
    assert describe(infos["lamp.power"]) == "How bright. [W, 0..100]"
    assert describe(infos["colour"]) == "Paint. [red | green]"
    assert describe(infos["lamp.fade_s"]) == "Fade time; empty is instant. [s, 0..]"
    assert describe(infos["name"]) == "Any text."


def test_nested_and_dotted_keys_mean_the_same():
    nested = from_mapping(House, {"lamp": {"power": 7}, "floors": 3})
    dotted = from_mapping(House, {"lamp.power": 7, "floors": 3})
    assert nested == dotted
    assert nested.lamp.power == 7.0
    assert isinstance(nested.lamp.power, float)
    assert nested.colour == "red"
    assert get(nested, "lamp.power") == 7.0


def test_base_is_kept_where_nothing_is_said():
    base = House(floors=4, lamp=Lamp(power=9.0))
    assert from_mapping(House, {"lamp": {"lit": True}}, base=base) == House(
        floors=4, lamp=Lamp(power=9.0, lit=True)
    )


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"flors": 3}, "unknown setting 'flors': did you mean 'floors'?"),
        ({"lamp": {"powr": 3}}, "unknown setting 'lamp.powr': did you mean 'lamp.power'?"),
        ({"lmap": {"power": 3}}, "unknown setting 'lmap': did you mean 'lamp'?"),
        ({"zzzzzz": 3}, "unknown setting 'zzzzzz': see dump-config for the known ones"),
        ({7: 3}, "unknown setting '7': see dump-config for the known ones"),
        ({"floors": 0}, "floors = 0 is out of range: Storeys. [1..9]"),
        ({"floors": 10}, "floors = 10 is out of range: Storeys. [1..9]"),
        ({"floors": 2.5}, "floors takes a whole number, got 2.5"),
        ({"floors": float("inf")}, "floors takes a whole number, got inf"),
        ({"floors": float("nan")}, "floors takes a whole number, got nan"),
        ({"floors": True}, "floors takes a number, got True"),
        ({"floors": "two"}, "floors takes a number, got 'two'"),
        ({"floors": [1]}, "floors takes a number, got [1]"),
        ({"floors": None}, "floors must not be empty"),
        ({"lamp": {"power": float("nan")}}, "lamp.power = nan is out of range: How bright. "
         "[W, 0..100]"),
        ({"lamp": {"lit": 1}}, "lamp.lit takes true or false, got 1"),
        ({"lamp": {"lit": "yes"}}, "lamp.lit takes true or false, got 'yes'"),
        ({"colour": "blue"}, "colour must be one of red, green, got 'blue'"),
        ({"rooms": 3}, "rooms takes a list, got 3"),
        ({"rooms": "12"}, "rooms takes a list, got '12'"),
        ({"lamp": 3}, "lamp is a group of settings, got 3"),
        ({"lamp": [1]}, "lamp is a group of settings, got [1]"),
    ],
)  # fmt: skip
def test_each_mistake_has_its_words(mapping, message):
    with pytest.raises(ConfigError) as caught:
        from_mapping(House, mapping)
    assert str(caught.value) == message


def test_all_mistakes_are_told_at_once():
    with pytest.raises(ConfigError) as caught:
        from_mapping(House, {"flors": 3, "floors": 0, "lamp": {"lit": 5, "power": 7}})
    told = str(caught.value).split("; ")
    assert told == [
        "unknown setting 'flors': did you mean 'floors'?",
        "floors = 0 is out of range: Storeys. [1..9]",
        "lamp.lit takes true or false, got 5",
    ]


def test_a_group_without_content_changes_nothing():
    """``lamp:`` with all its lines commented out."""
    assert load_yaml(House, "lamp:\n  # power: 3\nfloors: 3", origin="x") == House(floors=3)


def test_optional_settings_may_be_empty_and_ends_of_a_range_belong_to_it():
    assert from_mapping(House, {"lamp": {"fade_s": None}}).lamp.fade_s is None
    assert from_mapping(House, {"lamp": {"fade_s": 0}}).lamp.fade_s == 0.0
    assert from_mapping(House, {"floors": 1}).floors == 1
    assert from_mapping(House, {"floors": 9.0}).floors == 9


def test_lists_become_tuples():
    assert from_mapping(House, {"rooms": [3, 4]}).rooms == (3, 4)


@pytest.mark.parametrize("text", ["1e1", "1E+1", "10.0", "10", "1.0e1"])
def test_numbers_in_every_notation(text):
    """YAML 1.1 reads 1e-4 as text; people write it all the same."""
    assert load_yaml(House, f"lamp: {{power: {text}}}", origin="x").lamp.power == 10.0
    assert with_overrides(House(), [f"lamp.power={text}"]).lamp.power == 10.0


def test_overrides():
    changed = with_overrides(
        House(floors=4),
        ["lamp.power=3", "colour=green", "rooms=[9]", "lamp.lit=true", "lamp.power=4"],
    )
    assert changed == House(4, "green", "home", (9,), Lamp(4.0, True))
    assert with_overrides(House(), []) == House()


@pytest.mark.parametrize(
    ("assignments", "message"),
    [
        (["floors"], "--set takes key=value, got 'floors'"),
        (["=3"], "--set takes key=value, got '=3'"),
        (["floors=[1"], "--set floors=[1: '[1' is not a YAML value"),
        (["floors="], "floors must not be empty"),
        (["lamp.pover=3"], "unknown setting 'lamp.pover': did you mean 'lamp.power'?"),
    ],
)
def test_wrong_overrides(assignments, message):
    with pytest.raises(ConfigError) as caught:
        with_overrides(House(), assignments)
    assert str(caught.value) == message


def test_file_errors_name_the_file():
    with pytest.raises(ConfigError, match=r"^my\.yaml: unknown setting 'x'"):
        load_yaml(House, "x: 1", origin="my.yaml")
    with pytest.raises(ConfigError, match=r"^my\.yaml is not valid YAML: .*line 1") as caught:
        load_yaml(House, "a: [1", origin="my.yaml")
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"^my\.yaml must hold keys and values, not a list$"):
        load_yaml(House, "- 1", origin="my.yaml")


@pytest.mark.parametrize("text", ["", "# nothing\n", "---\n", "node:\n  ros__parameters:\n"])
def test_an_empty_document_is_all_defaults(text):
    assert load_yaml(House, text, origin="x") == House()


def test_ros_parameter_files_are_read_too():
    text = """
/stereo_odometry:
  ros__parameters:
    floors: 5
    lamp:
      power: 3.0
    lamp.lit: true
"""
    assert load_yaml(House, text, origin="x") == House(floors=5, lamp=Lamp(3.0, True))


houses = st.builds(
    House,
    floors=st.integers(1, 9),
    colour=st.sampled_from(["red", "green"]),
    name=st.text(st.characters(codec="utf-8", exclude_categories=["C"]), max_size=12),
    rooms=st.lists(st.floats(-1e6, 1e6), max_size=3).map(tuple),
    lamp=st.builds(
        Lamp, st.floats(0, 100), st.booleans(), st.none() | st.floats(0, 1e9, allow_nan=False)
    ),
)


@given(houses)
def test_dump_and_load_is_a_round_trip(house):
    assert load_yaml(House, dump_yaml(house), origin="x") == house


def test_dump_explains_each_setting():
    lines = dump_yaml(House()).splitlines()
    at = lines.index("  power: 5.0")
    assert lines[at - 1] == "  # How bright. [W, 0..100]"
    assert lines[lines.index("lamp:") - 1] == "# The lamp."
    assert sum(line.lstrip().startswith("#") for line in lines) == 8


def test_the_whole_configuration_round_trips():
    changed = with_overrides(
        Config(), ["odometry.solver=gauss_newton", "pairing.tolerance_ms=3", "agc.mode=linear"]
    )
    assert load_yaml(Config, dump_yaml(changed), origin="x") == changed
    assert flatten(changed) != flatten(Config())


def groups_of(cls):
    yield cls
    for item in fields(cls):
        if item.metadata.get("group"):
            yield from groups_of(item.default_factory)


def test_every_setting_of_the_program_is_declared_in_full():
    """Each field has a sentence; each default lies within its own range and choices."""
    for cls in groups_of(Config):
        assert is_dataclass(cls)
        assert cls.__dataclass_params__.frozen
        assert cls.__doc__
    for info in settings_of(Config):
        assert info.doc.strip().endswith("."), info.path
        assert info.kind in (int, float, str, bool, tuple), info.path
        from_mapping(Config, {info.path: info.default})
        if info.kind in (int, float):
            assert info.minimum is not None, f"{info.path} has no range"


def test_contracted_keys_are_there():
    """Tests and measurements outside rely on these names."""
    infos = {info.path: info for info in settings_of(Config)}
    assert infos["odometry.method"].default == "feature"
    assert "odometry.window" in infos
    assert set(infos["odometry.solver"].choices) == {
        "gauss_newton", "levenberg_marquardt", "double_dogleg",
    }  # fmt: skip
