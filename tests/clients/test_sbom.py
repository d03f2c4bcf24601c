"""The bill of materials against the standard's schema and a reader that is not ours."""

import json
import pathlib
import subprocess
import sys
import unittest

from cyclonedx.model.bom import Bom
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

ROOT = pathlib.Path(__file__).resolve().parents[2]


class Sbom(unittest.TestCase):
    def made(self, *words):
        run = subprocess.run([sys.executable, ROOT / ".ci/sbom", *words], capture_output=True, text=True)
        self.assertEqual(run.returncode, 0, run.stderr)
        return run.stdout

    def test_it_is_valid_whole_and_always_the_same(self):
        text = self.made()
        self.assertEqual(JsonStrictValidator(SchemaVersion.V1_5).validate_str(text), None)
        bom = Bom.from_json(json.loads(text))
        self.assertTrue(bom.validate())
        names = {component.name: component for component in bom.components}
        self.assertLessEqual({"mcap", "quinn", "sled", "openh264-sys2", "windhover-estimate"}, set(names))
        # What only tests use is not built in.
        self.assertNotIn("proptest", names)
        for component in bom.components:
            self.assertTrue(component.licenses, component.name)
            if not component.name.startswith("windhover"):
                self.assertEqual(len(component.hashes), 1, component.name)
        self.assertEqual(text, self.made())
        self.assertNotEqual(text, self.made("--target", "aarch64-unknown-linux-gnu"))


if __name__ == "__main__":
    unittest.main()
