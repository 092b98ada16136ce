from contextlib import suppress

import pytest
from pydantic import BaseModel

from labseq.errors import PluginLoadError, UnknownPluginError
from labseq.registry import KINDS, Owner, Registry
from labseq.settings import Settings


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
    with registry.opened_for(Owner("first")) as first:
        first.planner("mine", factory)
    with (
        pytest.raises(PluginLoadError, match="planner 'mine' is offered by 'first' already") as caught,
        registry.opened_for(Owner("second", "/lab/second.py")) as second,
    ):
        second.planner("mine", factory)
    assert (caught.value.plugin, caught.value.source) == ("second", "/lab/second.py")
    assert str(caught.value).endswith("; rename one of them; it comes from /lab/second.py")
    assert list(registry.contested) == [("planner", "mine")]
    with pytest.raises(UnknownPluginError, match="did you mean 'mine'"):
        registry.get("planner", "mien")


class Plain(BaseModel):
    port: str = ""


class Mine(Settings):
    port: str = ""


@pytest.mark.parametrize("model", [5, Plain, Mine()], ids=str)
def test_a_settings_model_is_a_class_of_settings(model):
    with pytest.raises(PluginLoadError, match=r"settings model of planner 'mine' is .*; expected a subclass"):
        Registry().planner("mine", factory, model)
    Registry().planner("mine", factory, Mine)


@pytest.mark.parametrize(
    ("model", "simulated"), [(None, {"port": "simulated"}), (Mine, {"prot": "x"}), (Mine, "simulated")]
)
def test_simulated_is_settings_of_the_model(model, simulated):
    with pytest.raises(PluginLoadError, match=r"'simulated' of device 'mine' is .*; expected settings of"):
        Registry().device("mine", factory, model, simulated=simulated)


def test_the_same_name_may_serve_several_kinds():
    registry = Registry()
    registry.camera("virtual", factory, virtual_time=True)
    registry.device("virtual", factory, Mine, simulated={"port": "simulated"})
    assert registry.get("camera", "virtual").virtual_time
    assert registry.get("device", "virtual").simulated == {"port": "simulated"}


ODD_NAMES = ["", 5, "two words", "../a", "1st", "\x1b[31m", "true"]


@pytest.mark.parametrize("name", [*ODD_NAMES, "a" * 65], ids=repr)
def test_names_that_no_file_could_name(name):
    with pytest.raises(PluginLoadError, match=r"a step (needs a name|cannot be called)") as caught:
        Registry().step(name, factory)
    assert str(caught.value).isprintable()


def test_a_step_cannot_be_called_as_the_key_beside_it():
    with pytest.raises(PluginLoadError, match="a step cannot be called 'name'"):
        Registry().step("name", factory)
    Registry().planner("name", factory)


@pytest.mark.parametrize("name", ["größe", "two-stage_2"])
def test_names_that_files_can_name(name):
    registry = Registry()
    registry.step(name, factory)
    assert registry.names("step") == [name]


def test_nothing_is_registered_later():
    registry = Registry()
    with registry.opened_for(Owner("late")) as own:
        own.planner("in_time", factory)
    with pytest.raises(PluginLoadError, match=r"registers planner 'mine' after its labseq_register has ret"):
        own.planner("mine", factory)
    assert registry.names("planner") == ["in_time"]


def test_a_plugin_that_fails_leaves_nothing():
    registry = Registry()
    with suppress(ZeroDivisionError), registry.opened_for(Owner("one")) as one:
        one.planner("a", factory)
        assert registry.names("planner") == ["a"]
        raise ZeroDivisionError
    assert registry.names("planner") == []
    with registry.opened_for(Owner("two")) as two:
        two.planner("b", factory)
    assert registry.names("planner") == ["b"]
    assert [e.name for e in registry.entries("two")] == ["b"]
