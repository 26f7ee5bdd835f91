"""`drivelink completion SHELL`: what a shell needs to complete verbs, options and files."""

import argparse

import shtab

from drivelink import cli

EPILOG = """\
examples:
  drivelink completion bash > ~/.local/share/bash-completion/completions/drivelink
  drivelink completion zsh > ~/.zfunc/_drivelink   with ~/.zfunc in fpath
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("shell", choices=("bash", "zsh"), help="the shell")


def run(args: argparse.Namespace) -> int:
    """Print the completion script."""
    parser = cli.make_parser(list(cli.VERBS))
    for action in parser._subparsers._group_actions:  # type: ignore[union-attr]
        for subparser in action.choices.values():  # type: ignore[union-attr]
            for argument in subparser._actions:
                if getattr(argument.type, "__name__", "") == "Path":
                    argument.complete = shtab.FILE
    print(shtab.complete(parser, shell=args.shell))
    return 0
