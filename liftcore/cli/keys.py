"""``splatlift keys``: the keys of the HTTP service, in a process of the service's own."""

import argparse
from pathlib import Path

from liftcore.cli.options import Parser, whole
from liftcore.cli.serve import become

QUOTAS = {
    "max_bytes": "most bytes stored, of its assets and lifts",
    "max_queued": "most jobs in line",
    "max_uploads": "most uploads at once",
}


def add_arguments(parser: Parser, shared: Parser) -> None:
    """The options of the command, which ``python -m service.keys`` takes too."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION", parser_class=Parser)
    create = actions.add_parser("create", parents=[shared], help="make a key and show it, once")
    create.add_argument("--name", required=True, metavar="NAME", help="whose it is, or what for")
    create.add_argument("--scopes", required=True, metavar="SCOPES", help="read,write,metrics,admin: what it may do")
    create.add_argument("--expires", metavar="WHEN", help="after 30d, 12h or 90m, or at a date (UTC); else never")
    for name, limit in QUOTAS.items():
        option = f"--{name.replace('_', '-')}"
        create.add_argument(option, type=whole, metavar="N", help=f"{limit}; else as the server is set")
    listing = actions.add_parser("list", parents=[shared], help="all keys, without their secrets")
    rotate = actions.add_parser("rotate", parents=[shared], help="give a key another secret and show it, once")
    rotate.add_argument("key", metavar="NAME", help="its name, or its id as keys list shows it")
    rotate.add_argument(
        "--grace", metavar="TIME", help="how long the secret before counts, such as 24h; else not at all"
    )
    revoke = actions.add_parser("revoke", parents=[shared], help="end a key; what it made stays, for admins")
    revoke.add_argument("key", metavar="ID", help="as keys list shows it")
    for action in (create, listing, rotate, revoke):
        action.add_argument("--data", type=Path, metavar="DIR", help="the service's directory")


def run(options: argparse.Namespace) -> int:
    """Become ``python -m service.keys``."""
    given = {name: getattr(options, name, None) for name in ("name", "scopes", "expires", *QUOTAS, "grace", "data")}
    arguments = [f"--{name.replace('_', '-')}={value}" for name, value in given.items() if value is not None]
    arguments += ["--json"] if options.json else []
    become("service.keys", [options.action, *arguments, *(["--", options.key] if "key" in options else [])])
