"""The verbs that put the simulator on a socket: `worldline serve`, and `worldline play` with its page."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_serve_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add them to the command line's parser."""
    texts = {
        "serve": "offer the simulator over a websocket (extra: serve)",
        "play": "drive the simulator by hand: serve, and say where its page is (extra: serve)",
    }
    for name, text in texts.items():
        parser = commands.add_parser(name, help=text)
        parser.add_argument(
            "--config", type=Path, metavar="FILE", help="what differs from the defaults (docs/serve.md)"
        )
        parser.add_argument(
            "--set", action="append", default=[], metavar="a.b=value", dest="overrides", help="change one value"
        )
        parser.set_defaults(run=serve_command)


def serve_command(arguments: argparse.Namespace) -> None:
    """Load the model and serve until interrupted."""
    from worldline_core.config import apply_overrides, load_config, validate
    from worldline_core.errors import UnavailableError, installing
    from worldline_core.serving.serve_config import ServeConfig

    overrides = tuple(arguments.overrides)
    if arguments.config is not None:
        config = load_config(ServeConfig, path=arguments.config, overrides=overrides)
    else:
        config = validate(ServeConfig, apply_overrides({}, overrides), where="--set")
    try:
        import msgpack  # noqa: F401

        from worldline_core.serving.app import listening_socket, make_server, server_token
    except ImportError as error:
        raise UnavailableError(
            "The server needs packages that are not here", got=str(error), next_step=installing("serve")
        ) from error
    from worldline_core.rollout.worldline import WorldLine
    from worldline_core.shipped import project_path

    token, project = server_token(config), Path.cwd()
    folders = [name for name in ("model", "tokenizer", "decoder", "episodes") if getattr(config, name) is not None]
    config = config.model_copy(update={name: project_path(project, getattr(config, name)) for name in folders})
    listening = listening_socket(config)  # before the model is loaded: whether there is a port is known at once
    world = WorldLine.from_pretrained(
        config.model,
        tokenizer=config.tokenizer,
        decoder=config.decoder,
        device=config.device,
        bfloat16=config.bfloat16,
        steps=config.steps,
    )
    server = make_server(world, config, token)
    host, port = f"[{config.host}]" if ":" in config.host else config.host, listening.getsockname()[1]
    print(f"{config.model} at ws://{host}:{port}/v1", flush=True)
    hint = "" if token is None else "#token=..., with the token of WORLDLINE_TOKEN"
    print(f"drive it by hand at http://{host}:{port}/play{hint}", flush=True)
    server.run(sockets=[listening])
