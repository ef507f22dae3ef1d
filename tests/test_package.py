"""The package's face: light to import, functions under their names."""

import subprocess
import sys


def _python(code: str) -> None:
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_import_is_light():
    _python(
        "import dcc_jax, sys;"
        "assert not {'jax', 'mujoco', 'numpy'} & sys.modules.keys();"
        "assert 'train' in dir(dcc_jax)"
    )


def test_function_is_not_hidden_by_the_module_of_its_name():
    _python(
        "import dcc_jax, dcc_jax.train, types;"
        "from dcc_jax.train import main;"
        "assert not isinstance(dcc_jax.train, types.ModuleType);"
        "assert dcc_jax.train.__name__ == 'train' and main.__name__ == 'main'"
    )


def test_unknown_name_is_an_attribute_error():
    _python(
        "import dcc_jax\n"
        "try: dcc_jax.nonsense\n"
        "except AttributeError as error: assert 'nonsense' in str(error)\n"
        "else: raise AssertionError"
    )
