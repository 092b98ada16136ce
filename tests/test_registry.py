import pytest
from pydantic import BaseModel

from labseq.errors import PluginLoadError
from labseq.registry import Registry
from labseq.settings import Settings


def factory(settings, context):
    return settings, context


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
