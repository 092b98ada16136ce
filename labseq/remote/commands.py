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
    help="Keys with which computers that share devices recognise each other.",
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
            metavar="NAME", help="Name of the files. Default: this computer's name.", show_default=False
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Folder of keys. Default: LABSEQ_KEYS.", show_default=False),
    ] = None,
) -> None:
    """Make the key of this computer, as a secret file and a public file for other computers.

    Each computer keeps the public keys of the other computers in the subfolder `known` of its key folder.
    Deleting a file there revokes the key at once, even for a connected computer.
    """
    import platform

    from labseq.console.output import say
    from labseq.wire import keys_root, new_keys, require_packages

    require_packages()
    secret, public = new_keys(name or platform.node(), folder or keys_root())
    say(f"{secret}: secret, stays on this computer")
    say(f"{public}: public, to be copied into the folder `known` in the key folders of other computers")


def serve_devices(
    profile: ProfileArgument,
    bind: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS", help="Address and port to listen on. The devices use the next ports."
        ),
    ] = "tcp://127.0.0.1:5760",
    device: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Serve only this device. May be repeated. Default: all real ones, or all if none is real.",
            show_default=False,
        ),
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="Serve without keys, only to programs on this computer.")
    ] = False,
    overrides: Overrides = None,
    _plugins: Plugins = None,
) -> None:
    """Serve the devices of a profile to a labseq on another computer, which uses them like its own.

    Each device is tested and made safe first. If a client disappears, its devices are made safe within a
    second. Ctrl-C makes all devices safe and ends the server.
    """
    from labseq.console.output import say
    from labseq.remote.server import Serving, serve_devices

    serve_devices(profile, overrides or (), Serving(bind, tuple(device or ()), plain), say)
