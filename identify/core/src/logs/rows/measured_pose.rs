//! Reads tables of a tracker. Each row is a pose of the robot with the position, or the position and orientation, that the
//! tracker measured there. The joints of the robot are in the same row ([`MeasuredPoses`]), or in the robot's own log at the
//! time of the row ([`TimedPoses`]).
//!
//! Trackers write different columns, so a mapping in TOML names the columns and their units.
//! `config/measured_pose.toml` explains each key.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use shared::config::{AngleUnit, Kind, Validate, Violation};

use super::pose_rows::{JointColumns, REMEDY, SetUpNames, check_joints, check_scale_u, rows, uncertainty};
use crate::kinematics::{Joints, nearest_rotation};
use crate::logs::source::LogSource;
use crate::logs::tables::csv_text::{CsvColumn, CsvRow, CsvTable};
use crate::logs::tables::stamp::{StampColumn, TimeColumn};
use crate::logs::time_series::excursions::{Excursions, Fastest, remark};
use crate::logs::time_series::stream::{remark_equal, retain};
use crate::logs::{CsvLayout, JointColumn, LengthUnit, LogError, Stamps, Stream, since_first_s};
use crate::model::SetUp;

/// Largest coordinate of a position, the range of a tracker \[m\]. A larger number means that the unit is wrong.
const POSITION_M_MAX: f64 = 100.0;
/// Largest speed of the end of a robot \[m/s\].
pub const SPEED_M_S_MAX: f64 = 10.0;
/// Upper bounds of a target's motion. At a higher acceleration, 5 g, the target would fall out of its nest.
const FASTEST: Fastest = Fastest { speed: SPEED_M_S_MAX, acceleration: 50.0 };
/// Largest angle of an orientation \[rad\]. A larger number means that the unit is wrong.
const ANGLE_RAD_MAX: f64 = 2.0 * std::f64::consts::TAU;

/// The columns of a position.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PositionColumns {
    /// Names of the columns x, y and z in the header.
    pub columns: [String; 3],
    /// Unit of the values in these columns.
    pub unit: LengthUnit,
}

/// The axes about which the three rotations of an orientation turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EulerFrame {
    /// Each rotation is about an axis that was turned by the rotations before it (intrinsic): `R = R1 R2 R3`.
    Moving,
    /// Each rotation is about an axis of the tracker (extrinsic): `R = R3 R2 R1`.
    Fixed,
}

/// How an orientation is written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RotationForm {
    /// Three angles of successive rotations, in `unit`. The axes are determined by `order` and `frame`.
    #[default]
    Euler,
    /// A rotation vector x, y, z: the unit vector of the axis times the angle in `unit`.
    RotationVector,
    /// A unit quaternion x, y, z, w, where w is the real part. The sign of the quaternion does not matter.
    Quaternion,
    /// A rotation matrix, row by row: r11, r12, r13, r21 and so on.
    Matrix,
}

/// The columns of the measured orientation.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RotationColumns {
    /// Meaning of the columns.
    #[serde(default, rename = "as")]
    pub form: RotationForm,
    /// Names of the columns in the header.
    pub columns: Vec<String>,
    /// Unit of the angles; absent for quaternions and matrices.
    pub unit: Option<AngleUnit>,
    /// Axes of the three rotations in the order of the columns, such as `xyz` or `zyz`; only for Euler angles.
    pub order: Option<String>,
    /// Whether each rotation also turns the axes of the rotations after it; only for Euler angles.
    pub frame: Option<EulerFrame>,
}

/// Largest deviation from a rotation that rounding of the numbers explains. If the deviation is larger, the numbers
/// are not an orientation.
const NOT_A_ROTATION: f64 = 1e-2;

/// The axes of three rotations; `None` for an invalid `order`.
fn axes(order: &str) -> Option<[Vector3<f64>; 3]> {
    let axis = |letter: u8| match letter {
        b'x' => Some(Vector3::x()),
        b'y' => Some(Vector3::y()),
        b'z' => Some(Vector3::z()),
        _ => None,
    };
    let &[a, b, c] = order.as_bytes() else { return None };
    if a == b || b == c {
        return None;
    }
    Some([axis(a)?, axis(b)?, axis(c)?])
}

impl RotationColumns {
    /// Checks that all keys that the form needs are present, and that no other keys are present.
    fn check(&self) -> Result<(), Violation> {
        use RotationForm::{Euler, Matrix, Quaternion, RotationVector};
        let columns = match self.form {
            Euler | RotationVector => 3,
            Quaternion => 4,
            Matrix => 9,
        };
        let (given, remedy) = (self.columns.len(), format!("write {columns}"));
        let problem = format!("{given} columns are given");
        Violation::unless(given == columns, "rotation.columns", problem, remedy)?;
        let has_angles = matches!(self.form, Euler | RotationVector);
        let is_euler = self.form == Euler;
        for (key, given, needed, example) in [
            ("unit", self.unit.is_some(), has_angles, "\"deg\" or \"rad\""),
            ("order", self.order.is_some(), is_euler, "\"xyz\", the axes of the turns"),
            ("frame", self.frame.is_some(), is_euler, "\"moving\" or \"fixed\""),
        ] {
            let (problem, remedy) = match (given, needed) {
                (false, true) => ("it is missing", format!("write {example}")),
                (true, false) => ("an orientation of this form has none", "remove it".to_owned()),
                _ => continue,
            };
            return Err(Violation::new(format!("rotation.{key}"), problem, remedy));
        }
        let Some(order) = &self.order else { return Ok(()) };
        let problem = format!("`{order}` is not an order of turns");
        let remedy = "write three letters of x, y, z with different neighbours, such as \"xyz\"";
        Violation::unless(axes(order).is_some(), "rotation.order", problem, remedy)
    }

    /// Returns the factor for the values of the columns (to radians; 1 for quaternion and matrix), and the largest valid
    /// absolute value after this factor.
    fn scale(&self) -> (f64, f64) {
        self.unit.map_or((1.0, 1.0 + NOT_A_ROTATION), |unit| (unit.to_rad(), ANGLE_RAD_MAX))
    }

    /// The rotation `tracker_from_probe` from the values of the columns, with angles in radians. `None` if the
    /// values are not a rotation.
    fn rotation(&self, values: &[f64]) -> Option<Rotation3<f64>> {
        match (self.form, values) {
            (RotationForm::Euler, &[first, second, third]) => {
                let [a, b, c] = axes(self.order.as_deref()?)?;
                let turn = |axis: Vector3<f64>, angle_rad: f64| Rotation3::new(axis * angle_rad);
                let (a, b, c) = (turn(a, first), turn(b, second), turn(c, third));
                Some(match self.frame? {
                    EulerFrame::Moving => a * b * c,
                    EulerFrame::Fixed => c * b * a,
                })
            }
            (RotationForm::RotationVector, &[x, y, z]) => Some(Rotation3::new(Vector3::new(x, y, z))),
            (RotationForm::Quaternion, &[x, y, z, w]) => {
                let quaternion = Quaternion::new(w, x, y, z);
                let is_unit = (quaternion.norm() - 1.0).abs() < NOT_A_ROTATION;
                is_unit.then(|| UnitQuaternion::new_normalize(quaternion).to_rotation_matrix())
            }
            (RotationForm::Matrix, values) if values.len() == 9 => {
                let given = Matrix3::from_row_slice(values);
                // The iteration of `Rotation3::from_matrix` does not end for left-handed axes.
                let nearest = nearest_rotation(&given);
                ((nearest.matrix() - given).amax() < NOT_A_ROTATION).then_some(nearest)
            }
            _ => None,
        }
    }
}

/// The columns with the standard uncertainties of each row.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UncertaintyColumns {
    /// Column with the uncertainty of each coordinate of the position \[mm\].
    pub position_mm: Option<String>,
    /// Column with the uncertainty of the orientation about each axis \[mrad\].
    pub rotation_mrad: Option<String>,
}

/// Standard uncertainties of a row in the file; `None` if the file does not contain them.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoseUncertainty {
    /// Standard uncertainty of each coordinate of the position \[m\].
    pub position_m: Option<f64>,
    /// Standard uncertainty of the orientation about each axis \[rad\].
    pub rotation_rad: Option<f64>,
}

/// Describes how to read a tracker's table.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredPoseMapping {
    /// Standard uncertainty of the tracker's scale \[ppm\]. If absent, it is that of a usual tracker. 0 means that
    /// the scale is exact.
    pub scale_u_ppm: Option<f64>,
    /// Layout of the table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// Columns of the measured position in the tracker's frame.
    pub position: PositionColumns,
    /// Columns of the measured orientation; `None` if only positions were measured.
    pub rotation: Option<RotationColumns>,
    /// Columns of the uncertainty of each row, if the file has these columns.
    pub uncertainty: Option<UncertaintyColumns>,
    /// Column with the name of the tracker's station, if the tracker was moved between several stations.
    pub station: Option<String>,
    /// Column with the name of the measured target, if there are several targets on the flange.
    pub target: Option<String>,
    /// Column with the time of each row on the tracker's clock. If present, the joints are taken from the robot's own log.
    pub time: Option<TimeColumn>,
    /// Columns of the joints, base to flange; empty if rows have times.
    #[serde(default)]
    pub joints: Vec<JointColumn>,
}

impl Validate for MeasuredPoseMapping {
    const KIND: Option<Kind> = Some(Kind::TrackerMapping);

    fn validate(&self) -> Result<(), Violation> {
        self.csv.check()?;
        check_scale_u(self.scale_u_ppm)?;
        self.rotation.as_ref().map_or(Ok(()), RotationColumns::check)?;
        if let Some(UncertaintyColumns { position_mm, rotation_mrad }) = &self.uncertainty {
            let remedy = "name the column of position_mm or rotation_mrad, or leave the block out";
            let is_named = position_mm.is_some() || rotation_mrad.is_some();
            Violation::unless(is_named, "uncertainty", "no column is named", remedy)?;
            let (key, problem) = ("uncertainty.rotation_mrad", "no orientation was measured");
            let is_measured = rotation_mrad.is_none() || self.rotation.is_some();
            Violation::unless(is_measured, key, problem, "leave it out, or add the [rotation] block")?;
        }
        let Some(time) = &self.time else { return check_joints(&self.joints) };
        time.check()?;
        let remedy = "name the column of the times";
        Violation::unless(!time.column.is_empty(), "time.column", "it is missing", remedy)?;
        let problem = "rows with [time] get their joints from the robot's own log";
        let remedy =
            "remove the [[joints]], or [time] if the joints of each row are those of its measurement";
        Violation::unless(self.joints.is_empty(), "joints", problem, remedy)
    }
}

/// A pose of the robot, with the tracker's measurement at this pose.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoseRow {
    /// Joint variables of the model \[rad, m\]. For rows with times they are empty until the first alignment with the
    /// robot's log, which determines them.
    pub joints_rad: Joints,
    /// Position of the probe in the tracker's frame \[m\].
    pub position_m: Vector3<f64>,
    /// Orientation `tracker_from_probe`. Orientations are used if every row contains one.
    pub rotation: Option<Rotation3<f64>>,
    /// Standard uncertainty of the measurement in the file.
    pub uncertainty: PoseUncertainty,
    /// Indices of station and target in the lists of names; 0 if the file does not name them.
    pub set_up: SetUp,
    /// Line number in the file, by which messages name the row.
    pub line: u64,
}

/// A table in which rows contain the joints.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeasuredPoses {
    /// Rows in the order of the file. It must be the order of the robot's motion, because backlash depends
    /// on the previous pose.
    pub rows: Vec<PoseRow>,
    /// Names of the stations in the order of the file; empty if the file does not name stations.
    pub stations: Vec<String>,
    /// Names of the targets in the order of the file; empty if the file does not name targets.
    pub targets: Vec<String>,
}

impl MeasuredPoses {
    /// Reads the table at `path`.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(path: &Path, mapping: &MeasuredPoseMapping) -> Result<Self, LogError> {
        Self::read(&LogSource::open(path)?.whole()?, path, mapping)
    }

    /// Like [`Self::load`], but for bytes in memory. `path` is only used in error messages.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(bytes: &[u8], path: &Path, mapping: &MeasuredPoseMapping) -> Result<Self, LogError> {
        let mut table = CsvTable::open(LogSource::in_memory(bytes, path), &mapping.csv)?;
        let columns = PoseColumns::find(&table, mapping)?;
        let joints = JointColumns::find(&table, &mapping.joints)?;
        let mut names = SetUpNames::default();
        let rows = rows(&mut table, |row| {
            let measured = columns.read(row, &mut names)?;
            Ok(PoseRow { joints_rad: joints.read(row)?, ..measured })
        })?;
        let [stations, targets] = names.in_order();
        Ok(Self { rows, stations, targets })
    }
}

/// A tracker's log on the tracker's own clock.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TimedPoses {
    /// Rows without joints. If a regular clock is found, their times are those of this clock, otherwise the stamps.
    pub rows: Stream<PoseRow>,
    /// Names of the stations in the order of the file; empty if the file does not name stations.
    pub stations: Vec<String>,
    /// Names of the targets in the order of the file; empty if the file does not name targets.
    pub targets: Vec<String>,
    /// Comparison of the stamps with the regular clock; `None` if no such clock is found.
    pub stamps: Option<Stamps>,
    /// Observations that the user should know, as sentences. None of them prevents the use of the log.
    pub remarks: Vec<String>,
}

impl TimedPoses {
    /// Reads the table at `path`. The `mapping` must have a column of times.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(path: &Path, mapping: &MeasuredPoseMapping) -> Result<Self, LogError> {
        Self::read(&LogSource::open(path)?.whole()?, path, mapping)
    }

    /// Like [`Self::load`], but for bytes in memory. `path` is only used in error messages.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(bytes: &[u8], path: &Path, mapping: &MeasuredPoseMapping) -> Result<Self, LogError> {
        let time = TimeColumn::of_table(mapping.time.as_ref(), path)?;
        let mut table = CsvTable::open(LogSource::in_memory(bytes, path), &mapping.csv)?;
        let columns = PoseColumns::find(&table, mapping)?;
        let mut stamps = StampColumn::find(&table, time, REMEDY)?;
        let mut names = SetUpNames::default();
        let mut rows = rows(&mut table, |row| {
            let pose = columns.read(row, &mut names)?;
            Ok((stamps.next_ns(row)?, pose))
        })?;
        let not_increasing = rows.windows(2).find(|pair| pair[1].0 < pair[0].0);
        if let Some([(before_ns, before), (after_ns, after)]) = not_increasing {
            let (before, after) = ((before.line, *before_ns), (after.line, *after_ns));
            return Err(LogError::time_not_increasing(path, "line", before, after));
        }
        // Two targets may be measured at the same time. The later row then gets the next nanosecond, so that it
        // is not a duplicate.
        for row in 1..rows.len() {
            let (before_ns, before) = rows[row - 1];
            let (stamp_ns, pose) = &mut rows[row];
            let is_other = i64::from(pose.set_up != before.set_up);
            *stamp_ns = (*stamp_ns).max(before_ns.saturating_add(is_other));
        }
        let (mut stamps_ns, mut rows): (_, Vec<PoseRow>) = rows.into_iter().unzip();
        let mut remarks: Vec<String> =
            drop_excursions(&mut stamps_ns, &mut rows, path)?.into_iter().collect();
        let (rows, stamps, is_kept) = Stream::from_stamps(stamps_ns, rows, |rows| motion(rows).into());
        remarks.extend(remark_equal(&is_kept, "line"));
        remarks.extend(stamps.iter().flat_map(Stamps::remarks));
        let [stations, targets] = names.in_order();
        Ok(Self { rows, stations, targets, stamps, remarks })
    }
}

/// Removes excursions, which occur when the beam is broken. Each combination of target and station is searched separately.
/// Returns a remark if there are any.
fn drop_excursions(
    stamps_ns: &mut Vec<i64>,
    rows: &mut Vec<PoseRow>,
    path: &Path,
) -> Result<Option<String>, LogError> {
    // A view contains the indices of the rows of one combination of station and target.
    let mut views: BTreeMap<SetUp, Vec<usize>> = BTreeMap::new();
    for (place, row) in rows.iter().enumerate() {
        views.entry(row.set_up).or_default().push(place);
    }
    let mut is_kept = vec![true; rows.len()];
    for view in views.values() {
        let t_s = since_first_s(&view.iter().map(|row| stamps_ns[*row]).collect::<Vec<_>>());
        let position_m = |row: usize, axis: usize| rows[view[row]].position_m[axis];
        let step = |from: usize, to: usize, axis: usize| position_m(to, axis) - position_m(from, axis);
        let excursions = Excursions { t_s: &t_s, columns: 3, fastest: FASTEST, step }.find();
        excursions.into_iter().for_each(|row| is_kept[view[row]] = false);
    }
    let lines = rows.iter().zip(&is_kept).filter(|(_, is_kept)| !**is_kept).map(|(row, _)| row.line);
    let remark = remark(&lines.collect::<Vec<_>>(), rows.len(), (path, "line"), "they are left out")?;
    retain(stamps_ns, &is_kept);
    retain(rows, &is_kept);
    Ok(remark)
}

/// The positions of the rows \[m\], without the steps at changes of target or station, because these steps are not
/// motion of the robot.
fn motion(rows: &[PoseRow]) -> Vec<Joints> {
    let mut before: Option<&PoseRow> = None;
    let mut steps_between_targets_m = Vector3::zeros();
    let positions = rows.iter().map(|row| {
        if let Some(before) = before.replace(row).filter(|before| row.set_up != before.set_up) {
            steps_between_targets_m += row.position_m - before.position_m;
        }
        let position_m = row.position_m - steps_between_targets_m;
        Joints::from_fn(3, |axis| position_m[axis])
    });
    positions.collect()
}

/// Columns of the tracker's measurements in an open table.
struct PoseColumns<'a> {
    position: (Vec<CsvColumn>, LengthUnit),
    rotation: Option<(Vec<CsvColumn>, &'a RotationColumns)>,
    /// Columns with the standard uncertainties of position \[mm\] and rotation \[mrad\].
    uncertainty: [Option<CsvColumn>; 2],
    /// Columns with the names of station and target.
    set_up: [Option<CsvColumn>; 2],
}

/// The numbers of a row in these columns, multiplied by `to_si`. A number larger than `largest` is an error. `si` is the
/// symbol of the SI unit.
fn numbers(
    row: &CsvRow<'_>,
    columns: &[CsvColumn],
    (to_si, si): (f64, &str),
    largest: f64,
) -> Result<Vec<f64>, LogError> {
    let number = |column: &CsvColumn| {
        let value = row.number(column)? * to_si;
        if value.abs() <= largest {
            return Ok(value);
        }
        if si.is_empty() {
            let problem = format!("{value:.3} is too large for a number of a rotation");
            return Err(row.bad(column, problem, "check `as` and the columns in the mapping file"));
        }
        let problem =
            format!("{value:.3} {si} is more than anything measured here (at most {largest:.1} {si})");
        Err(row.bad(column, problem, "check the column's unit in the mapping file"))
    };
    columns.iter().map(number).collect()
}

impl<'a> PoseColumns<'a> {
    fn find(table: &CsvTable<'_>, mapping: &'a MeasuredPoseMapping) -> Result<Self, LogError> {
        let rotation = mapping
            .rotation
            .as_ref()
            .map(|rotation| Ok((table.columns(&rotation.columns, REMEDY)?, rotation)));
        let uncertainty = mapping.uncertainty.as_ref();
        let position_u = uncertainty.and_then(|columns| columns.position_mm.as_ref());
        let rotation_u = uncertainty.and_then(|columns| columns.rotation_mrad.as_ref());
        Ok(Self {
            position: (table.columns(&mapping.position.columns, REMEDY)?, mapping.position.unit),
            rotation: rotation.transpose()?,
            uncertainty: [table.if_named(position_u, REMEDY)?, table.if_named(rotation_u, REMEDY)?],
            set_up: [
                table.if_named(mapping.station.as_ref(), REMEDY)?,
                table.if_named(mapping.target.as_ref(), REMEDY)?,
            ],
        })
    }

    fn read(&self, row: &CsvRow<'_>, names: &mut SetUpNames) -> Result<PoseRow, LogError> {
        let (columns, unit) = &self.position;
        let position_m = numbers(row, columns, (unit.to_m(), "m"), POSITION_M_MAX)?;
        let rotation = self.rotation.as_ref().map(|(columns, form)| rotation(row, columns, form));
        let [position_u, rotation_u] = self.uncertainty.each_ref().map(Option::as_ref);
        Ok(PoseRow {
            joints_rad: Joints::default(),
            line: row.line,
            position_m: Vector3::from_iterator(position_m),
            rotation: rotation.transpose()?,
            uncertainty: PoseUncertainty {
                position_m: uncertainty(row, position_u)?,
                rotation_rad: uncertainty(row, rotation_u)?,
            },
            set_up: names.place(row, &self.set_up)?,
        })
    }
}

fn rotation(
    row: &CsvRow<'_>,
    columns: &[CsvColumn],
    form: &RotationColumns,
) -> Result<Rotation3<f64>, LogError> {
    let (to_si, largest) = form.scale();
    let si = if form.unit.is_some() { "rad" } else { "" };
    let values = numbers(row, columns, (to_si, si), largest)?;
    form.rotation(&values).ok_or_else(|| {
        let names: Vec<&str> = columns.iter().map(|column| column.name.as_str()).collect();
        let cell = CsvColumn { index: 0, name: names.join(", ") };
        let problem = format!("{values:.3?} is not a rotation");
        row.bad(&cell, problem, "check `as` and the order of the columns in the mapping file")
    })
}
