"""The package against the program: tables equal to the program's own CSV, examples that say what the truth says."""

import pathlib
import shutil
import sys
import tempfile
import unittest

import numpy as np
import pandas as pd

HERE = pathlib.Path(__file__).resolve().parent
for folder in ("../src", "../examples", "../../tests/python"):
    sys.path.insert(0, str((HERE / folder).resolve()))

import accuracy  # noqa: E402
import ellipses  # noqa: E402
import rig  # noqa: E402
import sensors  # noqa: E402
from windhover_flight import Flight  # noqa: E402


class Package(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.at = pathlib.Path(folder.name)
        cls.path = cls.at / "flight.mcap"
        rig.windhover("simulate", cls.at / "capture.mcap", "--scenario", "follow", "--duration", 7, "--scale", 0.5)
        rig.windhover("replay", cls.at / "capture.mcap", "--out", cls.path)
        rig.windhover("export", cls.path, "--format", "csv", "--out", cls.at / "csv")
        cls.flight = Flight(cls.path)

    def table(self, name):
        return pd.read_csv(self.at / f"csv/{name}.csv")

    def test_states_are_those_of_the_csv(self):
        self.assertEqual((self.flight.targets, self.flight.warnings), (["ugv"], []))
        for kind, name in (("filtered", "estimates"), ("smoothed", "smoothed"), ("paper", "paper")):
            states, table = self.flight.states("ugv", kind), self.table(name)
            self.assertGreater(len(states), 20, kind)
            np.testing.assert_array_equal(states.index, table.time_ns)
            self.assertEqual(list(states.status), list(table.status))
            columns = ["frame", "north_m", "east_m", "heading_rad", "speed_mps", "yaw_rate_radps", "lat_deg", "lon_deg"]
            np.testing.assert_allclose(states[columns], table[columns], atol=1e-6, rtol=0)
            if kind != "paper":
                upper = table[[c for c in table if c.startswith("p_")]].to_numpy()
                rows, columns = np.triu_indices(5)
                covariance = self.flight.covariance("ugv", kind)
                np.testing.assert_allclose(covariance[:, rows, columns], upper, rtol=1e-9)
                np.testing.assert_array_equal(covariance, covariance.transpose(0, 2, 1))
                np.testing.assert_allclose(self.flight.sigmas("ugv", kind).north_m ** 2, table.p_nn, rtol=1e-9)

    def test_own_state_and_detections_are_those_of_the_csv(self):
        own, table = self.flight.ownship, self.table("ownship")
        np.testing.assert_array_equal(own.index, table.time_ns)
        np.testing.assert_array_equal(own.frame, table.frame.fillna(-1))
        columns = [c for c in table if c not in ("time_ns", "frame")]
        np.testing.assert_allclose(own[columns], table[columns], atol=1e-4, rtol=0)
        self.assertTrue((np.linalg.eigvalsh(self.flight.ownship_covariance[-1]) > 0).all())
        seen, table = self.flight.detections, self.table("detections")
        np.testing.assert_array_equal(seen.index, table.time_ns)
        columns = ["id", "hamming", "center_u", "u0", "v3"]
        np.testing.assert_allclose(seen[columns], table[columns], atol=1e-4)
        np.testing.assert_allclose(self.flight.datum, self.table("datum").iloc[0], atol=1e-4)
        self.assertEqual(self.flight.config["target"][0]["name"], "ugv")

    def test_refined_states_are_those_of_the_csv(self):
        rig.windhover("refine", self.path, "--out", self.at / "refined.mcap")
        rig.windhover("export", self.at / "refined.mcap", "--format", "csv", "--out", self.at / "refined")
        flight, table = Flight(self.at / "refined.mcap"), pd.read_csv(self.at / "refined/refined.csv")
        states = flight.states("ugv", "refined")
        self.assertGreater(len(states), 50)
        np.testing.assert_array_equal(states.index, table.time_ns)
        np.testing.assert_allclose(states[["north_m", "heading_rad", "lat_deg"]], table[["north_m", "heading_rad", "lat_deg"]], atol=1e-6, rtol=0)
        upper = table[[c for c in table if c.startswith("p_")]].to_numpy()
        rows, columns = np.triu_indices(5)
        np.testing.assert_allclose(flight.covariance("ugv", "refined")[:, rows, columns], upper, rtol=1e-9)
        self.assertGreater(len(flight.ownship_refined), 50)
        self.assertEqual(flight.ownship_refined_covariance.shape, (len(flight.ownship_refined), 9, 9))

    def test_frames_are_the_recordings(self):
        frames = list(self.flight.frames())
        np.testing.assert_array_equal([f.number for f in frames], self.table("estimates").frame)
        np.testing.assert_array_equal([f.time_ns for f in frames], self.table("estimates").time_ns)
        self.assertEqual({(f.encoding, f.data[:2]) for f in frames}, {("jpeg", b"\xff\xd8")})

    def test_a_cut_file_is_read_to_its_last_whole_record(self):
        whole = self.path.read_bytes()
        last = 0
        for share in (0.3, 0.7, 0.99):
            cut = self.at / f"cut{share}.mcap"
            cut.write_bytes(whole[: int(len(whole) * share)])
            flight = Flight(cut)
            self.assertEqual(len(flight.warnings), 1)
            self.assertIn("cut off", flight.warnings[0])
            states = flight.states("ugv")
            self.assertGreater(len(states), last)
            last = len(states)
            expected = self.flight.states("ugv").loc[states.index]
            pd.testing.assert_frame_equal(states, expected)
        self.assertTrue(np.isnan(Flight(cut).covariance("ugv", "refined")).all())

    def test_a_directory_of_segments_is_one_flight(self):
        card = self.at / "20261118T150405Z"
        card.mkdir()
        for name in ("000000.mcap", "000001.mcap"):
            shutil.copy(self.path, card / name)
        twice = Flight(card)
        self.assertEqual(len(twice.states("ugv")), 2 * len(self.flight.states("ugv")))
        (self.at / "text.mcap").write_text("no recording")
        with self.assertRaisesRegex(ValueError, "not an MCAP recording"):
            Flight(self.at / "text.mcap")
        with self.assertRaisesRegex(KeyError, "no target"):
            self.flight.states("nobody")
        with self.assertRaisesRegex(ValueError, "none of filtered"):
            self.flight.states("ugv", "best")

    def test_the_examples(self):
        results = accuracy.main(self.path, self.at / "capture.truth.csv")
        rms, nees = results["filtered"]
        self.assertLess(rms.north_m + rms.east_m, 3.0)
        self.assertTrue(0.5 < nees < 20, nees)
        self.assertLess(results["smoothed"][0].heading_rad, 0.1)

        rates, became = sensors.main(self.path)
        self.assertAlmostEqual(rates.rate_hz.gps, 5, delta=0.5)
        self.assertGreater(became.loc["marker", "fused"], 100)

        shapes = ellipses.main(self.path)["features"]
        self.assertTrue(4 <= len(shapes) <= 7, len(shapes))
        lon, lat = np.mean(shapes[-1]["geometry"]["coordinates"][0][:-1], axis=0)
        table = self.table("estimates")
        last = table[table.time_ns >= table.time_ns.iloc[-1] - 10**9]
        self.assertTrue(last.lat_deg.min() - 1e-7 <= lat <= last.lat_deg.max() + 1e-7)
        self.assertTrue(shapes[0]["properties"]["utc"].startswith("2026-11"), shapes[0]["properties"])


if __name__ == "__main__":
    unittest.main()
