"""The Python package out of `pip`, in a folder of its own."""

import pathlib
import subprocess
import sys
import tempfile
import unittest

ROOT = pathlib.Path(__file__).resolve().parents[2]


class Install(unittest.TestCase):
    def test_pip_makes_a_package_that_imports(self):
        with tempfile.TemporaryDirectory() as folder:
            # A copy: setuptools leaves its scratch files beside the sources.
            subprocess.run(["cp", "-r", ROOT / "python", f"{folder}/python"], check=True)
            pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", f"{folder}/there"]
            subprocess.run([*pip, f"{folder}/python"], check=True)
            names = {path.name for path in pathlib.Path(folder, "there").iterdir()}
            self.assertIn("windhover_flight", names)
            self.assertTrue(any(name.startswith("windhover_flight-0") for name in names), names)
            words = "import windhover_flight; print(windhover_flight.__file__, windhover_flight.Flight)"
            said = subprocess.run([sys.executable, "-c", words], cwd=f"{folder}/there", capture_output=True, text=True, check=True)
            self.assertIn("there/windhover_flight", said.stdout)


if __name__ == "__main__":
    unittest.main()
