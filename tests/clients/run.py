"""Runs the tests of this folder, all or those whose files are named. A file whose packages could not be had is left out, which is
said at once and once more at the end."""

import importlib
import pathlib
import subprocess
import sys
import unittest

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parents[1]


def main():
    sys.path.insert(0, str(HERE))
    suite, left_out = unittest.TestSuite(), []
    for name in sys.argv[1:] or sorted(path.stem for path in HERE.glob("test_*.py")):
        try:
            suite.addTest(unittest.defaultTestLoader.loadTestsFromModule(importlib.import_module(name)))
        except ModuleNotFoundError as error:
            subprocess.run(["sh", ROOT / ".ci/skip", f"tests/clients/{name}.py", str(error)], check=True)
            left_out.append(f"{name}: {error}")
    result = unittest.TextTestRunner(verbosity=2).run(suite)
    left_out += [f"{test.id()}: {why}" for test, why in result.skipped]
    print("\n".join(["left out:", *left_out] if left_out else ["nothing was left out"]))
    sys.exit(not result.wasSuccessful())


if __name__ == "__main__":
    main()
