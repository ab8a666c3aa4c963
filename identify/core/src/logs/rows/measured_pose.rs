//! Poses of the robot with the position, or the whole pose, that a tracker measured there. The robot's joints are in the same
//! row, or in the robot's own log at the time of the row.
//!
//! Files differ, so a mapping in TOML names the columns and their units; `config/measured_pose.toml` explains each key.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use shared::config::{AngleUnit, Kind, Validate, Violation};

use super::pose_rows::{JointColumns, REMEDY, SetUpNames, check_joints, check_scale_u, rows, uncertainty};
use crate::kinematics::Joints;
use crate::logs::source::LogSource;
use crate::logs::tables::csv_text::{CsvColumn, CsvRow, CsvTable};
use crate::logs::tables::stamp::{StampColumn, TimeColumn};
use crate::logs::time_series::excursions::{Excursions, Fastest, remark};
use crate::logs::time_series::stream::retain;
use crate::logs::{CsvLayout, JointColumn, LengthUnit, LogError, Stamps, Stream, since_first_s};
use crate::model::SetUp;

/// Range of a tracker \[m\]; a larger number means a wrong unit.
const POSITION_M_MAX: f64 = 100.0;
/// No robot moves its end faster \[m/s\].
pub const SPEED_M_S_MAX: f64 = 10.0;
/// At a higher acceleration than 5 g no target would stay in its nest.
const FASTEST: Fastest = Fastest { speed: SPEED_M_S_MAX, acceleration: 50.0 };
/// No angle of an orientation is larger \[rad\]; more means a wrong unit.
const ANGLE_RAD_MAX: f64 = 2.0 * std::f64::consts::TAU;

/// The columns of a position.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PositionColumns {
    /// Names in the header: x, y, z.
    pub columns: [String; 3],
    /// Unit of their values.
    pub unit: LengthUnit,
}

/// Axes of the angles of an orientation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EulerFrame {
    /// Each turn is about an axis that the turns before it have moved (intrinsic): `R = R1 R2 R3`.
    Moving,
    /// All are about the tracker's own axes (extrinsic): `R = R3 R2 R1`.
    Fixed,
}

/// How an orientation is written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RotationForm {
    /// Three successive rotations by `unit`, `order` and `frame`.
    #[default]
    Euler,
    /// Axis times angle, x, y, z, in `unit`.
    RotationVector,
    /// A unit quaternion, x, y, z and then w, the real part; its sign does not matter.
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
    /// Names in the header.
    pub columns: Vec<String>,
    /// Unit of the angles of an orientation.
    pub unit: Option<AngleUnit>,
    /// Axes of Euler's turns in the order of the columns, such as `xyz` or `zyz`.
    pub order: Option<String>,
    /// Whether Euler's turns carry the axes along.
    pub frame: Option<EulerFrame>,
}

/// Largest deviation of the rounded numbers of an orientation from a rotation; more means that they are something else.
const NOT_A_ROTATION: f64 = 1e-2;

/// Axes of three rotations; `None` for an invalid `order`.
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
    /// Checks that all that the form needs is given, and nothing else.
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

    /// Factor of the columns' values (to radians; 1 for quaternion and matrix), and their largest size after it.
    fn scale(&self) -> (f64, f64) {
        self.unit.map_or((1.0, 1.0 + NOT_A_ROTATION), |unit| (unit.to_rad(), ANGLE_RAD_MAX))
    }

    /// `tracker_from_probe` of the columns' values, angles in radians; `None` if they are not a rotation.
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
                let nearest = Rotation3::from_matrix(&given);
                ((nearest.matrix() - given).amax() < NOT_A_ROTATION).then_some(nearest)
            }
            _ => None,
        }
    }
}

/// The columns of stated standard uncertainties, by the unit that they are in.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UncertaintyColumns {
    /// Of each coordinate of the position.
    pub position_mm: Option<String>,
    /// Of the orientation about each axis.
    pub rotation_mrad: Option<String>,
}

/// Standard uncertainties that a file states of a row.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoseUncertainty {
    /// Of each coordinate \[m\].
    pub position_m: Option<f64>,
    /// About each axis \[rad\].
    pub rotation_rad: Option<f64>,
}

/// Columns of a tracker's table.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredPoseMapping {
    /// Standard uncertainty of the tracker's scale \[ppm\]; absent: that of a usual tracker, zero: exact.
    pub scale_u_ppm: Option<f64>,
    /// Layout of the table.
    #[serde(default)]
    pub csv: CsvLayout,
    /// Columns of the measured position in the tracker's frame.
    pub position: PositionColumns,
    /// Column of the measured orientation; `None` if only positions were measured.
    pub rotation: Option<RotationColumns>,
    /// Columns of the uncertainty of each row, if the file has them.
    pub uncertainty: Option<UncertaintyColumns>,
    /// The column with the name of the tracker's station, if it had several.
    pub station: Option<String>,
    /// The column with the name of the measured target, if the flange has several.
    pub target: Option<String>,
    /// When each row was measured, on the tracker's clock; the joints are then in the robot's own log.
    pub time: Option<TimeColumn>,
    /// Joints of each row, base to flange; empty if rows have times.
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

/// A pose of the robot, and the measurement of the tracker there.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoseRow {
    /// Joint variables of the model \[rad, m\]: of the row, or for rows with times those of the first alignment, none before it.
    pub joints_rad: Joints,
    /// Position of the probe in the tracker's frame \[m\].
    pub position_m: Vector3<f64>,
    /// `tracker_from_probe`; used if every row has one.
    pub rotation: Option<Rotation3<f64>>,
    /// Stated uncertainty of the measurement.
    pub uncertainty: PoseUncertainty,
    /// Station of the tracker and target, by their places among the names; 0 if the file does not name them.
    pub set_up: SetUp,
    /// Line of the source file, so that a row can be found again.
    pub line: u64,
}

/// The rows of a file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeasuredPoses {
    /// Rows in the order of the file, which is that of the robot's motion: backlash depends on the previous pose.
    pub rows: Vec<PoseRow>,
    /// Names of the stations in the order of the file; empty if it does not name them.
    pub stations: Vec<String>,
    /// And of the targets.
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

    /// [`Self::load`] on bytes in memory; `path` is only named in errors.
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

/// A tracker's log on its own clock.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TimedPoses {
    /// Rows at the times of the regular clock behind the stamps, if there is one; they have no joints.
    pub rows: Stream<PoseRow>,
    /// Names of the stations in the order of the file; empty if it does not name them.
    pub stations: Vec<String>,
    /// And of the targets.
    pub targets: Vec<String>,
    /// The stamps against that clock.
    pub stamps: Option<Stamps>,
    /// Observations that are not errors, in sentences.
    pub remarks: Vec<String>,
}

impl TimedPoses {
    /// Reads the table at `path`, whose `mapping` has a column of times.
    ///
    /// # Errors
    /// Every way in which the file cannot be used, see [`LogError`].
    pub fn load(path: &Path, mapping: &MeasuredPoseMapping) -> Result<Self, LogError> {
        Self::read(&LogSource::open(path)?.whole()?, path, mapping)
    }

    /// [`Self::load`] on bytes in memory; `path` is only named in errors.
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
        // Rows of two targets at one time are not duplicates: the later one gets the next nanosecond.
        for row in 1..rows.len() {
            let (before_ns, before) = rows[row - 1];
            let (stamp_ns, pose) = &mut rows[row];
            let is_other = i64::from(pose.set_up != before.set_up);
            *stamp_ns = (*stamp_ns).max(before_ns.saturating_add(is_other));
        }
        let (mut stamps_ns, mut rows): (_, Vec<PoseRow>) = rows.into_iter().unzip();
        let remarks = drop_excursions(&mut stamps_ns, &mut rows, path)?.into_iter().collect();
        let (rows, stamps, _) = Stream::from_stamps(stamps_ns, rows, |rows| motion(rows).into());
        let [stations, targets] = names.in_order();
        Ok(Self { rows, stations, targets, stamps, remarks })
    }
}

/// Removes rows of a broken beam, for each target and station; returns a remark if there are any.
fn drop_excursions(
    stamps_ns: &mut Vec<i64>,
    rows: &mut Vec<PoseRow>,
    path: &Path,
) -> Result<Option<String>, LogError> {
    // The rows of each station and target.
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

/// Positions of the rows \[m\] without the steps from one target or station to another: the robot does not make them.
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

/// Columns of the tracker's measurements in a file, by the mapping.
struct PoseColumns<'a> {
    position: (Vec<CsvColumn>, LengthUnit),
    rotation: Option<(Vec<CsvColumn>, &'a RotationColumns)>,
    /// Standard uncertainties of position \[mm\] and rotation \[mrad\].
    uncertainty: [Option<CsvColumn>; 2],
    /// Names of station and target.
    set_up: [Option<CsvColumn>; 2],
}

/// Numbers of a row times `to_si`, none of them larger than `largest`; `si` is the symbol of the SI unit.
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
