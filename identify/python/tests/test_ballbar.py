"""Tests the package as users call it: compared with the command, compared with independent readers, and in a notebook."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import ballbar
import numpy as np

HERE = Path(__file__).resolve().parent
CONFIG = HERE.parents[2] / "config"
ROBOT, BAR = CONFIG / "robots/irb2400_16.toml", CONFIG / "ball_bar.toml"
IDENTIFY = os.environ["BALLBAR_IDENTIFY"]
POSTURES = np.radians([[10, 20, -10, 30, 40, 50], [0, 10, 0, 10, 20, 10], [-50, -30, 20, 100, -60, -120.0]])


def without_places(calibration):
    """The calibration without the entries that depend on the time and place of its creation."""
    inputs = [(one["role"], one["sha256"]) for one in calibration["inputs"]]
    return {**calibration, "created": None, "inputs": inputs}


class Package(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.place = tempfile.TemporaryDirectory()
        cls.addClassCleanup(cls.place.cleanup)
        cls.home = Path(cls.place.name)
        cls.run_directory = ballbar.simulate(cls.home / "run", robot=ROBOT, bar=BAR, seed=np.int64(3), duration="40s")
        cls.files = {"recording": cls.run_directory / "recording.mcap", "robot_log": cls.run_directory / "robot_log.csv"}
        with cls().assertLogs("ballbar", "INFO") as cls.logged:
            cls.calibration = ballbar.calibrate(**cls.files, robot=ROBOT, bar=BAR)

    def test_a_calibration_is_that_of_the_command(self):
        words = [f"--{name.replace('_', '-')}={path}" for name, path in self.files.items()]
        out = self.home / "command"
        words = [IDENTIFY, "calibrate", "bar", *words, f"--robot={ROBOT}", f"--bar={BAR}", f"--out={out}"]
        printed = subprocess.run(words, check=True, capture_output=True, text=True).stdout
        by_command = json.loads((out / "calibration.json").read_text())
        self.assertEqual(without_places(self.calibration.file), without_places(by_command))
        logged = [line.removeprefix("INFO:ballbar:") for line in self.logged.output]
        verdict = next(line for line in printed.splitlines() if "verdict" in line.lower())
        self.assertIn(verdict, logged)
        opened = ballbar.Calibration(out)
        np.testing.assert_array_equal(opened.forward(POSTURES), self.calibration.forward(POSTURES))

    def test_poses_are_those_that_yourdfpy_finds_in_the_urdf(self):
        import yourdfpy

        # A URDF cannot describe errors of gears, so the simulated robot has none.
        run = ballbar.simulate(self.home / "exact", robot=ROBOT, bar=BAR, exact=True, duration="40s")
        files = {"recording": run / "recording.mcap", "robot_log": run / "robot_log.csv"}
        out = self.home / "urdf"
        calibration = ballbar.calibrate(**files, robot=ROBOT, bar=BAR, out=out)
        arm = yourdfpy.URDF.load(str(out / "robot.urdf"), load_meshes=False)
        for q, pose in zip(POSTURES, calibration.forward(POSTURES)):
            arm.update_cfg(q)
            np.testing.assert_allclose(arm.get_transform("ball_bar_end", "base"), pose, atol=1e-9)

    def test_what_is_reached_is_reported(self):
        poses = self.calibration.forward(POSTURES)
        np.testing.assert_allclose(self.calibration.inverse(poses, POSTURES + 0.05), POSTURES, atol=1e-9)
        self.assertEqual(self.calibration.forward(POSTURES.reshape(3, 1, 6)).shape, (3, 1, 4, 4))
        self.assertEqual(self.calibration.inverse(poses[0], POSTURES[0]).shape, (6,))

    def test_uncertainties_are_covariances(self):
        covariances = self.calibration.uncertainty(np.random.default_rng(1).uniform(-0.5, 0.5, (100, 6)))
        np.testing.assert_allclose(covariances, covariances.swapaxes(-1, -2), rtol=1e-9, atol=1e-18)
        self.assertTrue((np.linalg.eigvalsh(covariances) > -1e-15).all())

    def test_a_recording_has_what_an_independent_reader_finds(self):
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory

        recording = ballbar.read_recording(self.files["recording"])
        with open(self.files["recording"], "rb") as stream:
            messages = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages(["/ballbard/joint_states"])
            angles = np.array([message.position for _, _, _, message in messages])
        np.testing.assert_array_equal(recording.angle_rad, angles)
        self.assertEqual(recording.run["encoders"][0]["joint"], recording.joints[0])
        self.assertEqual(recording.end["cycles"], len(recording.cycle))
        self.assertTrue((np.diff(recording.time_ns) > 0).all())

    def test_warnings_about_a_table_of_counts_are_logged(self):
        recording = ballbar.read_recording(self.files["recording"])
        lines = ["t_s," + ",".join(f"count{joint}" for joint in recording.joints)]
        for time_ns, counts in zip(recording.time_ns - recording.time_ns[0], recording.count):
            lines.append(f"{time_ns * 1e-9:.9f}," + ",".join(map(str, counts)))
        # The last row is repeated, which causes a warning.
        table = self.home / "counts.csv"
        table.write_text("\n".join([*lines, lines[-1]]) + "\n")
        with self.assertLogs("ballbar", "WARNING") as logged:
            ballbar.calibrate(recording=table, robot_log=self.files["robot_log"], robot=ROBOT, bar=BAR)
        warned = [line for line in logged.output if "counts.csv" in line and "repeat the one before" in line]
        self.assertEqual(len(warned), 1, logged.output)

    def test_what_is_wrong_is_refused_with_what_to_do(self):
        calibration = self.calibration
        other = self.home / "other"
        other.mkdir()

        def calibration_of(text):
            (other / "calibration.json").write_text(text)
            return ballbar.Calibration(other)

        for wrong, told in [
            (lambda: ballbar.calibrate(robot=ROBOT, bar=BAR), "--recording"),
            (lambda: ballbar.calibrate(**self.files, robot=ROBOT, bar=BAR, nonsense=1), "--nonsense"),
            (lambda: ballbar.calibrate(**self.files, robot="none.toml", bar=BAR), "none.toml"),
            (lambda: ballbar.read_recording(ROBOT), "MCAP"),
            (lambda: calibration.forward([0.0, 1.0]), "(.., 6)"),
            (lambda: calibration.forward([np.nan] * 6), "finite"),
            (lambda: calibration.inverse(np.zeros((4, 4)), POSTURES[0]), "homogeneous"),
            (lambda: calibration.inverse(np.eye(4) + 9 * np.eye(4, k=3), POSTURES[0]), "out of reach"),
            (lambda: ballbar.Calibration(self.home), "identify calibrate"),
            (lambda: calibration_of("{}"), "is not a calibration"),
            (lambda: calibration_of("[]"), "is not a calibration"),
        ]:
            with self.assertRaises(ballbar.Error) as refused:
                wrong()
            self.assertIn(told, str(refused.exception))

    def test_a_configuration_that_has_changed_is_not_taken_for_that_of_the_calibration(self):
        robot, out = self.home / "robot.toml", self.home / "changed"
        robot.write_bytes(ROBOT.read_bytes())
        ballbar.calibrate(**self.files, robot=robot, bar=BAR, out=out)
        robot.write_text(robot.read_text() + "\n# another\n")
        with self.assertRaisesRegex(ballbar.Error, "has changed since the calibration; give robot="):
            ballbar.Calibration(out)
        self.assertEqual(ballbar.Calibration(out, robot=ROBOT).axes, 6)

    def test_a_robot_and_a_bar_that_are_built_in_are_found_by_their_names(self):
        self.assertEqual(ballbar.calibrate(**self.files, robot="irb2400_16").values, self.calibration.values)

    def test_ctrl_c_ends_a_study_and_python_goes_on(self):
        program = (
            "import ballbar, signal\n"
            # If these tests run in the background, the shell makes them ignore SIGINT. Restore the default handler.
            "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
            "try:\n"
            "    print('begun', flush=True)\n"
            f"    ballbar.study('thesis', out={str(self.home / 'study')!r}, figures='3.2', threads=1)\n"
            "except KeyboardInterrupt:\n"
            "    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler\n"
            "    print('ended', flush=True)\n"
        )
        with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
            self.assertEqual(process.stdout.readline(), "begun\n")
            while not (self.home / "study/trials.jsonl").exists():
                self.assertIsNone(process.poll())
            process.send_signal(signal.SIGINT)
            self.assertEqual(process.stdout.read(), "ended\n")
            self.assertEqual(process.wait(), 0)

    def test_the_notebook_draws_its_figure(self):
        import nbformat
        from nbclient import NotebookClient

        notebook = nbformat.read(HERE.parent / "figure_3_2.ipynb", as_version=4)
        os.environ["BALLBAR_SEEDS"] = "1"
        NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(self.home)}}).execute()
        outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
        self.assertEqual([output for output in outputs if output["output_type"] == "error"], [])
        self.assertTrue(any("image/png" in output.get("data", {}) for output in outputs))


if __name__ == "__main__":
    unittest.main()
