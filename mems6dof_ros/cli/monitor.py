"""`mems6dof monitor`: the live page, in any browser on this machine."""

from __future__ import annotations

import argparse


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parsers of `mems6dof`."""
    parser = subparsers.add_parser(
        "monitor",
        help="serve the live page",
        description="Serve the live page of a running instrument; prints the address to open in a browser.",
    )
    parser.add_argument("--port", type=int, help="TCP port; 0: any free one (default: 8606)")
    parser.add_argument(
        "--address",
        help="address to listen on; other than localhost, a token is asked for (default: 127.0.0.1)",
    )
    parser.add_argument("--tls-cert", help="PEM file: serve https instead of http; needs --tls-key")
    parser.add_argument("--tls-key", help="PEM file of the certificate's private key")
    parser.add_argument("ros_args", nargs="*", metavar="-- ROS arguments", help="for example -r __ns:=/left")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the node until it is interrupted; returns the exit status."""
    from mems6dof_ros.nodes import monitor  # needs ROS, the other commands do not
    from mems6dof_ros.nodes.parameters import to_yaml

    parameters = {
        "port": options.port,
        "address": options.address,
        "tls_certificate": options.tls_cert,
        "tls_key": options.tls_key,
    }
    arguments = ["--ros-args", *options.ros_args]
    for name, value in parameters.items():
        if value is not None:
            arguments += ["-p", f"{name}:={to_yaml(value)}"]
    return monitor.main(arguments)
