from contextlib import suppress

import pytest

from labseq.errors import PluginLoadError, UnknownPluginError
from labseq.registry import KINDS, Registry


def factory(settings, context):
    return settings, context


def test_there_is_a_method_for_every_kind():
    registry = Registry()
    for kind in KINDS:
        getattr(registry, kind)("mine", factory)
        assert registry.get(kind, "mine").factory is factory
        assert registry.names(kind) == ["mine"]
    assert [entry.kind for entry in registry.entries()] == list(KINDS)


def test_a_name_that_is_taken_names_both_origins():
    registry = Registry()
    registry.set_origin("first")
    registry.planner("mine", factory)
    registry.set_origin("second")
    with pytest.raises(PluginLoadError, match="planner 'mine' is offered by 'first' already") as caught:
        registry.planner("mine", factory)
    assert caught.value.plugin == "second"


def test_a_name_that_is_taken_is_contested():
    registry = Registry()
    for origin in ("first", "second"):
        registry.set_origin(origin)
        with suppress(PluginLoadError):
            registry.planner("mine", factory)
    assert list(registry.contested) == [("planner", "mine")]


def test_a_settings_model_is_a_class_of_settings():
    with pytest.raises(PluginLoadError, match=r"settings model of planner 'mine' is 5; expected a subclass"):
        Registry().planner("mine", factory, 5)  # pyright: ignore[reportArgumentType]


def test_the_same_name_may_serve_several_kinds():
    registry = Registry()
    registry.camera("virtual", factory, virtual_time=True)
    registry.device("virtual", factory, simulated={"port": "simulated"})
    assert registry.get("camera", "virtual").virtual_time
    assert registry.get("device", "virtual").simulated == {"port": "simulated"}


def test_an_unknown_name_suggests_the_nearest():
    registry = Registry()
    registry.planner("psca", factory)
    with pytest.raises(UnknownPluginError, match="did you mean 'psca'"):
        registry.get("planner", "pcsa")
    assert registry.find("planner", "pcsa") is None


def test_a_plugin_can_be_dropped_whole():
    registry = Registry()
    registry.set_origin("one")
    registry.planner("a", factory)
    registry.set_origin("two")
    registry.planner("b", factory)
    registry.drop_origin("one")
    assert registry.names("planner") == ["b"]
    assert [e.name for e in registry.entries("two")] == ["b"]
