//! Decides what the names of the columns leave open, by comparison with the nominal robot. With a tracker, this is about
//! signs, order and unit of the joints, and the form of the orientation. The choice with the smallest residuals is used.
//! With a wire, the question is whether a group of columns contains positions of the flange.

use std::path::Path;

use shared::config::RobotConfig;

use super::columns::{TableColumn, group};
use super::joints::angle_unit;
use super::{Notes, listed};
use crate::calibrate::rows::{likely, misfit, some_of};
use crate::instrument::{Instrument, Measures, Mistake, PoseError, Tracker, Wire};
use crate::kinematics::flange_chain;
use crate::logs::{
    EulerFrame, JointColumn, JointMistake, JointUnit, MeasuredLengthMapping, MeasuredLengths,
    MeasuredPoseMapping, MeasuredPoses, PositionColumns, RotationColumns, RotationForm,
};
use crate::report::rows::OTHER_ROBOT_M;

/// Table and robot, which are compared to decide what the names of the columns leave open.
pub(super) struct ResidualTrial<'a> {
    pub(super) bytes: &'a [u8],
    pub(super) path: &'a Path,
    pub(super) robot: &'a RobotConfig,
}

impl ResidualTrial<'_> {
    /// Reads the rows with this mapping. `None` if they cannot be read.
    fn rows(&self, mapping: &MeasuredPoseMapping) -> Option<Instrument> {
        let read = MeasuredPoses::read(self.bytes, self.path, mapping).ok()?;
        Some(Tracker::new(&read.rows).into())
    }

    /// RMS residuals of the nominal robot with this mapping.
    fn misfit(&self, mapping: &MeasuredPoseMapping) -> Option<PoseError> {
        misfit(&some_of(&self.rows(mapping)?), &flange_chain(self.robot))
    }

    /// Corrects signs, order and unit of the joints in the mapping, and adds the columns of the orientation. Both are chosen
    /// so that the rows fit the nominal robot best.
    pub(super) fn corrected(
        &self,
        mut mapping: MeasuredPoseMapping,
        others: &[&TableColumn],
        notes: &mut Notes,
    ) -> MeasuredPoseMapping {
        /// If the orientation is read correctly, the nominal robot deviates from it by less than this \[rad\]. With any
        /// wrong reading, it deviates more.
        const FITS_RAD: f64 = 0.1;
        // Mistakes in the joints are found by the positions alone. The orientation is tried
        // afterwards, with corrected joints.
        if let Some(rows) = self.rows(&mapping) {
            let chain = flange_chain(self.robot);
            match likely(&rows, &chain, &Mistake::of_joints(mapping.joints.len())) {
                Some(likely) => {
                    if let Mistake::Joints(mistake) = likely.mistake {
                        undo(&mut mapping.joints, mistake);
                    }
                    notes.doubt(format!("{likely}; it is written so"));
                }
                None => {
                    if let Some(PoseError { position_m, .. }) = self.misfit(&mapping) {
                        let distance =
                            format!("the nominal robot is {:.1} mm from the positions", position_m * 1e3);
                        if position_m > OTHER_ROBOT_M {
                            notes.doubt(format!(
                                "{distance}: check the zeros of its joints, and that the table is of this robot"
                            ));
                        } else {
                            notes.reason(distance);
                        }
                    }
                }
            }
        }
        let with =
            |rotation: RotationColumns| MeasuredPoseMapping { rotation: Some(rotation), ..mapping.clone() };
        let trials = orientations(others).into_iter().filter_map(|rotation| {
            let mapping = with(rotation);
            Some((self.misfit(&mapping)?.rotation_rad.unwrap_or(0.0), mapping))
        });
        match trials.min_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((rms_rad, best)) if rms_rad < FITS_RAD => {
                notes.reason(format!(
                    "the orientation is what fits the robot best, {:.1} mrad",
                    rms_rad * 1e3
                ));
                best
            }
            Some((rms_rad, _)) => {
                notes.doubt(format!(
                    "no reading of the orientation fits the robot ({:.0} mrad at best): left out",
                    rms_rad * 1e3
                ));
                mapping
            }
            None => mapping,
        }
    }

    /// Adds these columns to the mapping as positions of the flange, if the flange of the nominal robot is at these
    /// positions. Otherwise they may be positions of a tool, or in another frame.
    pub(super) fn with_flange(
        &self,
        mapping: MeasuredLengthMapping,
        xyz: Option<[&TableColumn; 3]>,
        notes: &mut Notes,
    ) -> MeasuredLengthMapping {
        let Some(xyz) = xyz else { return mapping };
        let columns = xyz.map(|column| column.name.clone());
        let ((unit, why), names) = (xyz[0].length_unit(), listed(&columns));
        let with_flange =
            MeasuredLengthMapping { flange: Some(PositionColumns { columns, unit }), ..mapping.clone() };
        let Ok(read) = MeasuredLengths::read(self.bytes, self.path, &with_flange) else { return mapping };
        if let Err(error) = Wire::new(&read.rows).contradicting(&flange_chain(self.robot)) {
            notes.doubt(format!("{names} are left out: {error}"));
            return mapping;
        }
        notes.reason(format!(
            "{names} are the controller's own positions of the flange: the nominal robot is there at the same joints; {why}"
        ));
        with_flange
    }
}

/// Undoes a mistake in the columns of the joints.
fn undo(joints: &mut [JointColumn], mistake: JointMistake) {
    match mistake {
        JointMistake::Reversed(joint) => joints[joint].sign = -joints[joint].sign,
        JointMistake::Exchanged(one, other) => joints.swap(one, other),
        JointMistake::InRadians | JointMistake::InDegrees => {
            for joint in joints {
                joint.unit = if joint.unit == JointUnit::Deg { JointUnit::Rad } else { JointUnit::Deg };
            }
        }
    }
}

/// All orientations that the columns can represent: form, order and frame. Only columns with usual names of
/// an orientation are considered.
fn orientations(columns: &[&TableColumn]) -> Vec<RotationColumns> {
    const THREE: [[&str; 3]; 5] = [
        ["rx", "ry", "rz"],
        ["roll", "pitch", "yaw"],
        ["a", "b", "c"],
        ["w", "p", "r"],
        ["rotx", "roty", "rotz"],
    ];
    const FOUR: [[&str; 4]; 2] = [["qx", "qy", "qz", "qw"], ["q_x", "q_y", "q_z", "q_w"]];
    const NINE: [&str; 9] = ["r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33"];
    const ORDERS: [&str; 12] =
        ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "xyx", "xzx", "yxy", "yzy", "zxz", "zyz"];
    let rotation = |form, group: Vec<&TableColumn>| RotationColumns {
        form,
        columns: group.iter().map(|column| column.name.clone()).collect(),
        ..RotationColumns::default()
    };
    let mut all = Vec::new();
    all.extend(group(columns, &NINE).map(|group| rotation(RotationForm::Matrix, group)));
    let four = FOUR.iter().filter_map(|words| group(columns, words));
    all.extend(four.map(|group| rotation(RotationForm::Quaternion, group)));
    for three in THREE.iter().filter_map(|words| group(columns, words)) {
        let unit = Some(angle_unit(&three, &mut Notes::default()));
        let vector = RotationColumns { unit, ..rotation(RotationForm::RotationVector, three) };
        let euler = |order: &str, frame| RotationColumns {
            form: RotationForm::Euler,
            order: Some(order.to_owned()),
            frame: Some(frame),
            ..vector.clone()
        };
        let frames = [EulerFrame::Moving, EulerFrame::Fixed];
        all.extend(ORDERS.iter().flat_map(|order| frames.map(|frame| euler(order, frame))));
        all.push(vector);
    }
    all
}
