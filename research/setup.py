"""Compiles the kernels that draw scenes into this folder, with what compiles those of the product."""

import runpy
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

HERE = Path(__file__).resolve().parent
PRODUCT = runpy.run_path(str(HERE.parent / "setup.py"), run_name="product")


class BuildWithKernels(build_py):
    """Puts the libraries into the checkout: this package is only ever installed from one."""

    def run(self) -> None:
        super().run()
        PRODUCT["build_kernels"](
            HERE / "kernels" / "lib", PRODUCT["target_machine"](), HERE / "kernels" / "src", (PRODUCT["SOURCES"],)
        )


if __name__ == "__main__":
    setup(cmdclass={"build_py": BuildWithKernels})
