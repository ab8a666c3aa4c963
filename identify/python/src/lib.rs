//! Native module of the Python package `ballbar`. It provides the commands of `identify`, calibrated robots, and recordings.
//! Tables are passed as bytes in the byte order of the machine, which NumPy uses without a copy.

use std::ffi::OsString;
use std::io;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use identify::commands::{self, IdentifyArguments, allow_commands, interrupt};
use identify::kinematics::Pose;
use identify::report::CalibratedRobot;
use identify::report::result::file::{CalibrationFile, InputFile};
use nalgebra::{Matrix3, Rotation3, Vector3};
use pyo3::create_exception;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;
use shared::config::{self, BallBarConfig, RobotConfig};
use shared::output::{captured, explained};
use shared::recording::Recording;
use shared::recording::schema::CycleRecord;

/// Interval between checks in the calling thread: whether the command has ended, and whether Ctrl-C was pressed.
const POLL_PERIOD: Duration = Duration::from_millis(10);
/// If an entry of `R^T R - I` exceeds this value, the matrix `R` is not accepted as a rotation.
const ROTATION_TOLERANCE: f64 = 1e-6;

create_exception!(ballbar, Error, PyValueError, "What is wrong, where, and what to do.");

fn py_error(error: impl Into<Box<dyn std::error::Error>>) -> PyErr {
    Error::new_err(explained(error.into().as_ref()))
}

/// Runs a command line. Its first word is the name of the program. Returns standard output and
/// warnings. Ctrl-C ends the command.
#[pyfunction]
fn run(py: Python<'_>, words: Vec<OsString>) -> PyResult<(String, String)> {
    let arguments =
        IdentifyArguments::from_words(words).map_err(|error| Error::new_err(error.render().to_string()))?;
    // A Ctrl-C that ended an earlier command must not end this one, so clear it.
    allow_commands();
    let warnings = LogLines::default();
    let writer = warnings.clone();
    let subscriber = tracing_subscriber::fmt()
        .with_max_level(tracing::Level::WARN)
        .with_ansi(false)
        .with_target(false)
        .with_level(false)
        .without_time()
        .with_writer(move || writer.clone())
        .finish();
    let work = move || {
        let (result, printed) =
            captured(|| tracing::subscriber::with_default(subscriber, || commands::run(arguments)));
        (result.map_err(|error| explained(error.as_ref())), printed)
    };
    let work = std::thread::Builder::new().name("identify".into()).spawn(work)?;
    let mut interrupted = Ok(());
    while !work.is_finished() {
        py.detach(|| std::thread::sleep(POLL_PERIOD));
        if let Err(signal) = py.check_signals() {
            interrupt();
            interrupted = Err(signal);
        }
    }
    let panicked = |_| Error::new_err("the command panicked; report this error with the call");
    let (result, printed) = work.join().map_err(panicked)?;
    interrupted?;
    result.map_err(Error::new_err)?;
    Ok((printed, warnings.text()))
}

/// A writer that collects log lines in memory.
#[derive(Clone, Default)]
struct LogLines(Arc<Mutex<Vec<u8>>>);

impl LogLines {
    fn text(&self) -> String {
        String::from_utf8_lossy(&self.0.lock().unwrap_or_else(PoisonError::into_inner)).into_owned()
    }
}

impl io::Write for LogLines {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Concatenates numbers that are encoded as `N` bytes each.
fn bytes<'py, const N: usize>(
    py: Python<'py>,
    numbers: impl Iterator<Item = [u8; N]>,
) -> Bound<'py, PyBytes> {
    PyBytes::new(py, &numbers.flatten().collect::<Vec<u8>>())
}

/// Decodes `bytes` into rows of `width` numbers.
fn rows(bytes: &[u8], width: usize) -> Vec<Vec<f64>> {
    let (numbers, _) = bytes.as_chunks::<8>();
    let rows = numbers.chunks_exact(width);
    rows.map(|row| row.iter().map(|number| f64::from_ne_bytes(*number)).collect()).collect()
}

/// A calibrated robot. Matrices are passed row by row, as in NumPy.
#[pyclass(frozen)]
struct Robot(CalibratedRobot);

impl Robot {
    /// Calls `of` with each row of joints and concatenates the results.
    fn map_rows<'py, const N: usize>(
        &self,
        py: Python<'py>,
        joints: &[u8],
        of: impl Fn(&[f64]) -> PyResult<[f64; N]>,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let results: Vec<[f64; N]> =
            rows(joints, self.0.axes()).iter().map(|q| of(q)).collect::<PyResult<_>>()?;
        Ok(bytes(py, results.iter().flatten().map(|number| number.to_ne_bytes())))
    }
}

#[pymethods]
impl Robot {
    #[new]
    #[pyo3(signature = (calibration, robot, bar=None))]
    fn new(calibration: PathBuf, robot: PathBuf, bar: Option<PathBuf>) -> PyResult<Self> {
        let file = CalibrationFile::open(&calibration).map_err(py_error)?;
        let robot: RobotConfig = config::load(&robot).map_err(py_error)?;
        let bar: Option<BallBarConfig> = bar.map(|path| config::load(&path)).transpose().map_err(py_error)?;
        CalibratedRobot::new(&file, &robot, bar.as_ref()).map(Self).map_err(py_error)
    }

    #[getter]
    fn axes(&self) -> usize {
        self.0.axes()
    }

    /// Converts rows of joints \[rad, m\] to homogeneous matrices \[m\] of 16 numbers each.
    fn forward<'py>(&self, py: Python<'py>, joints: &[u8]) -> PyResult<Bound<'py, PyBytes>> {
        self.map_rows::<16>(py, joints, |q| {
            let pose = self.0.forward(q).map_err(py_error)?.to_homogeneous();
            Ok(std::array::from_fn(|index| pose[(index / 4, index % 4)]))
        })
    }

    /// Converts rows of joints \[rad, m\] to covariances of position \[m\] and rotation vector \[rad\], 36 numbers each.
    fn covariance<'py>(&self, py: Python<'py>, joints: &[u8]) -> PyResult<Bound<'py, PyBytes>> {
        self.map_rows::<36>(py, joints, |q| {
            let covariance = self.0.covariance(q).map_err(py_error)?;
            Ok(std::array::from_fn(|index| covariance[index]))
        })
    }

    /// Converts homogeneous matrices \[m\] to rows of joints \[rad, m\]. If a pose has several solutions, the one
    /// nearest to the row of `near` is returned.
    fn inverse<'py>(&self, py: Python<'py>, poses: &[u8], near: &[u8]) -> PyResult<Bound<'py, PyBytes>> {
        let mut reached = Vec::new();
        for (pose, near) in rows(poses, 16).iter().zip(rows(near, self.0.axes())) {
            reached.extend(&self.0.inverse(&pose_of(pose)?, &near).map_err(py_error)?);
        }
        Ok(bytes(py, reached.iter().map(|joint: &f64| joint.to_ne_bytes())))
    }
}

/// The pose of a homogeneous matrix whose entries are given row by row. Returns an error if the matrix is not a pose.
fn pose_of(matrix: &[f64]) -> PyResult<Pose> {
    let at = |row: usize, column: usize| matrix.get(4 * row + column).copied().unwrap_or(f64::NAN);
    let rotation = Matrix3::from_fn(at);
    let deviation = (rotation.transpose() * rotation - Matrix3::identity()).amax();
    let position = Vector3::from_fn(|row, _| at(row, 3));
    let is_pose = deviation < ROTATION_TOLERANCE
        && rotation.determinant() > 0.0
        && position.iter().all(|number| number.is_finite())
        && (0..4).all(|column| at(3, column) == f64::from(u8::from(column == 3)));
    if !is_pose {
        return Err(Error::new_err("a pose is not a homogeneous matrix [R p; 0 0 0 1] with a rotation R"));
    }
    Ok(Pose::from_parts(position.into(), Rotation3::from_matrix_unchecked(rotation)))
}

/// A recording whose tables are encoded as bytes. Each table has one row for each cycle. Tables of
/// encoders have one column for each encoder.
#[pyclass(frozen, get_all)]
struct RecordingTables {
    joints: Vec<u8>,
    cycle: Py<PyBytes>,
    time_ns: Py<PyBytes>,
    time_uncertainty_ns: Py<PyBytes>,
    flags: Py<PyBytes>,
    origin: Py<PyBytes>,
    count: Py<PyBytes>,
    valid: Py<PyBytes>,
    angle_rad: Py<PyBytes>,
    /// Time \[ns\], cycle, kind, text.
    events: Vec<(i64, u64, String, String)>,
    /// Metadata of the run as JSON.
    run: String,
    /// End of the run as JSON.
    end: String,
}

/// Reads a finished recording.
#[pyfunction]
fn read_recording(py: Python<'_>, path: PathBuf) -> PyResult<RecordingTables> {
    let Recording { run, cycles, events, end, .. } =
        py.detach(|| Recording::open(&path)).map_err(py_error)?;
    let mut unwrappers: Vec<_> = run.encoders.iter().map(|encoder| encoder.scale.unwrapper()).collect();
    let mut angles_rad = Vec::with_capacity(cycles.len() * run.encoders.len());
    for cycle in &cycles {
        for ((encoder, unwrapper), sample) in run.encoders.iter().zip(&mut unwrappers).zip(cycle.encoders()) {
            let count = sample.valid.then(|| unwrapper.next(sample.count));
            angles_rad.push(count.map_or(f64::NAN, |count| encoder.scale.counts_to_rad(count)));
        }
    }
    let encoders = || cycles.iter().flat_map(CycleRecord::encoders);
    let event_kind = |kind| format!("{kind:?}").to_lowercase();
    Ok(RecordingTables {
        joints: run.encoders.iter().map(|encoder| encoder.joint).collect(),
        cycle: bytes(py, cycles.iter().map(|one| one.cycle.to_ne_bytes())).unbind(),
        time_ns: bytes(py, cycles.iter().map(|one| one.sample_time.0.to_ne_bytes())).unbind(),
        time_uncertainty_ns: bytes(py, cycles.iter().map(|one| one.sample_time_uncertainty_ns.to_ne_bytes()))
            .unbind(),
        flags: bytes(py, cycles.iter().map(|one| one.flags.to_ne_bytes())).unbind(),
        origin: bytes(py, cycles.iter().map(|one| one.origin.to_ne_bytes())).unbind(),
        count: bytes(py, encoders().map(|one| one.count.to_ne_bytes())).unbind(),
        valid: bytes(py, encoders().map(|one| [u8::from(one.valid)])).unbind(),
        angle_rad: bytes(py, angles_rad.iter().map(|one| one.to_ne_bytes())).unbind(),
        events: (events.into_iter())
            .map(|event| (event.time.0, event.cycle, event_kind(event.kind), event.text))
            .collect(),
        run: serde_json::to_string(&run).map_err(py_error)?,
        end: serde_json::to_string(&end).map_err(py_error)?,
    })
}

/// Hexadecimal SHA-256 of a file, or of the built-in configuration with this name.
#[pyfunction]
fn checksum(path: PathBuf) -> PyResult<String> {
    let read =
        InputFile::read("", &path).map_err(|error| py_error(format!("{}: {error}", path.display())))?;
    Ok(read.sha256)
}

#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("Error", module.py().get_type::<Error>())?;
    module.add_class::<Robot>()?;
    module.add_class::<RecordingTables>()?;
    module.add_function(wrap_pyfunction!(run, module)?)?;
    module.add_function(wrap_pyfunction!(checksum, module)?)?;
    module.add_function(wrap_pyfunction!(read_recording, module)?)
}
