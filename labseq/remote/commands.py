"""The commands `labseq serve-devices` and `labseq keys`."""

from pathlib import Path
from typing import Annotated

import typer

from labseq.console.options import Overrides, Plugins, ProfileArgument

SERVE_EXAMPLES = """\b
Examples:
  labseq serve-devices camera_pc --bind tcp://0.0.0.0:5760
  labseq serve-devices practice --plain --bind tcp://127.0.0.1:5760
"""

keys = typer.Typer(
    name="keys",
    help="Keys by which computers that share devices recognise each other.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@keys.command(
    epilog="\b\nExamples:\n  labseq keys new\n  labseq keys new camera-pc\n",
    short_help="Make the key of this computer.",
)
def new(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME", help="Name of the files; default: that of this computer.", show_default=False
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Folder of keys; default: LABSEQ_KEYS.", show_default=False),
    ] = None,
) -> None:
    """Make the key of this computer: a secret file, and a public one for the other computers.

    Each computer keeps the public keys of those it works with in the folder `known` of its folder of keys.
    Deleting a file there withdraws the key, also from a computer that is connected.
    """
    import platform

    from labseq.console.output import say
    from labseq.wire import keys_root, new_keys, require_packages

    require_packages()
    secret, public = new_keys(name or platform.node(), folder or keys_root())
    say(f"{secret}: secret; it stays on this computer")
    say(f"{public}: public; copy it into the folder `known` of the keys of other computers")


def serve_devices(
    profile: ProfileArgument,
    bind: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS", help="Address and port to listen on; each device has one of the next ports."
        ),
    ] = "tcp://127.0.0.1:5760",
    device: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Serve only this device; may be repeated. Default: all real ones, or all if none is real.",
            show_default=False,
        ),
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="Without keys, for programs on this computer only.")
    ] = False,
    overrides: Overrides = None,
    _plugins: Plugins = None,
) -> None:
    """Serve the devices of a profile to a labseq on another computer, which uses them as its own.

    Each device is tested and made safe first. If a client disappears, its devices are made safe within a
    second. Ctrl-C makes all devices safe and ends the server.
    """
    from labseq.console.output import say
    from labseq.remote.server import Serving, serve_devices

    serve_devices(profile, overrides or (), Serving(bind, tuple(device or ()), plain), say)
