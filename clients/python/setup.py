"""Generates the stubs from the .proto files while the package is built; they are never committed."""

import pathlib
import shutil

from setuptools import setup
from setuptools.command.build_py import build_py

PROTO = pathlib.Path(__file__).resolve().parent.parent.parent / "proto"


class Generated(build_py):
    """The package, and beside it `midshift`: messages and stubs as protoc makes them, with their types."""

    def run(self):
        super().run()
        generate(pathlib.Path(self.build_lib))


def generate(out: pathlib.Path) -> None:
    """Writes messages, types and stubs of every .proto file below `out`, and the retry rules into the package."""
    from grpc_tools import protoc

    import grpc_tools

    files = sorted(str(path) for path in PROTO.glob("midshift/**/*.proto"))
    if not files:
        raise SystemExit(f"no .proto files below {PROTO}")
    well_known = pathlib.Path(grpc_tools.__file__).parent / "_proto"
    options = [f"--{kind}_out={out}" for kind in ("python", "pyi", "grpc_python")]
    if protoc.main(["protoc", f"-I{PROTO}", f"-I{well_known}", *options, *files]) != 0:
        raise SystemExit("protoc failed")
    shutil.copy(PROTO / "service_config.json", out / "midshift_client" / "service_config.json")


setup(cmdclass={"build_py": Generated})
