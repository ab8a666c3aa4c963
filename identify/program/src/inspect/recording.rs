//! Inspection of a recording of `ballbard`: description, valid cycles, sample times, motion of the encoders, and events.

use shared::config::JointKind;
use shared::recording::Recording;
use shared::recording::schema::{CycleRecord, EncoderInfo, flags};

use super::{Inspection, JointLine, joint_lines, suspect_still};
use crate::prepare::{BarAngles, bar_angles};
use crate::report::summary::SIMULATED;

/// No robot moves a bar faster than this \[deg/s\]. A larger speed shows that the counts jumped.
const SPEED_MAX_DEG_S: f64 = 720.0;
/// A larger uncertainty of sample times reduces the accuracy of a calibration \[ns\]. At 0.5 rad/s, 150 us correspond to 75
/// urad, which is the whole error budget.
const UNCERTAINTY_MAX_NS: u32 = 150_000;

/// Reports the content of a recording and warns about suspicious findings.
pub fn recording(recording: &Recording) -> Inspection {
    let mut inspection = Inspection::default();
    facts(&mut inspection, recording);
    quality(&mut inspection, &recording.cycles);
    times(&mut inspection, recording);
    motion(&mut inspection, &recording.cycles, &recording.run.encoders);
    for event in &recording.events {
        inspection.fact(event.kind.name(), format!("{} (cycle {}): {}", event.time, event.cycle, event.text));
    }
    inspection
}

fn facts(inspection: &mut Inspection, recording: &Recording) {
    let run = &recording.run;
    if run.is_simulated() {
        inspection.fact("origin", SIMULATED);
    }
    inspection.fact("run", run.name.clone());
    let noted = [
        ("operator", &run.operator),
        ("robot", &run.robot),
        ("bar", &run.bar),
        ("payload", &run.payload),
        ("note", &run.note),
    ];
    for (what, value) in noted {
        if !value.is_empty() {
            inspection.fact(what, value.clone());
        }
    }
    let seconds = recording.cycles.len() as f64 * run.cycle_period_ns as f64 * 1e-9;
    let rate_hz = 1e9 / run.cycle_period_ns.max(1) as f64;
    inspection.fact("begins", run.started.to_string());
    inspection
        .fact("length", format!("{seconds:.1} s, {} cycles at {rate_hz:.0} Hz", recording.cycles.len()));
    inspection.fact("recorded by", format!("{} on {}", run.software, run.bus));
    encoders(inspection, &run.encoders);
    inspection.fact("ended", recording.end.cause.clone());
    if recording.end.recovered {
        inspection.suspect("the run was cut short and recovered; what came after its end was never written");
    }
    if !run.distributed_clocks {
        inspection.suspect(
            "recorded without distributed clocks: each sample may be a whole cycle old; repeat with distributed clocks",
        );
    }
}

/// Reports the joints that have an encoder, in the order of the file.
pub(super) fn encoders(inspection: &mut Inspection, encoders: &[EncoderInfo]) {
    let joints: Vec<String> = encoders.iter().map(|encoder| format!("b{}", encoder.joint)).collect();
    inspection.fact("encoders", joints.join(" "));
}

/// Reports the number of valid cycles, the flags, and changes of the counters' origin.
pub(super) fn quality(inspection: &mut Inspection, cycles: &[CycleRecord]) {
    let valid = cycles.iter().filter(|cycle| cycle.is_valid()).count();
    let percent = 100.0 * valid as f64 / cycles.len().max(1) as f64;
    inspection.fact("valid", format!("{valid} of {} cycles ({percent:.2} %)", cycles.len()));
    let mut flagged = flags::NAMES.map(|(flag, name)| (flag, name, 0));
    for cycle in cycles.iter().filter(|cycle| cycle.flags != 0) {
        flagged.iter_mut().for_each(|(flag, _, count)| *count += usize::from(cycle.flags & *flag != 0));
    }
    for (_, name, count) in flagged.into_iter().filter(|(.., count)| *count > 0) {
        inspection.fact(&format!("flagged {name}"), format!("{count} cycles"));
    }
    if percent < 95.0 {
        inspection
            .suspect(format!("only {percent:.1} % of the cycles are valid: look at its flags and events"));
    }
    let origins = cycles.windows(2).filter(|pair| pair[1].origin != pair[0].origin).count();
    if origins > 0 {
        inspection.suspect(format!(
            "the counters may have a new origin at {origins} places: each part has encoder offsets of its own"
        ));
    }
}

/// Reports sample times that are uncertain or do not increase, and missing cycles.
fn times(inspection: &mut Inspection, recording: &Recording) {
    let cycles = &recording.cycles;
    let uncertain = cycles
        .iter()
        .filter(|cycle| cycle.is_valid() && cycle.sample_time_uncertainty_ns > UNCERTAINTY_MAX_NS)
        .count();
    if uncertain > 0 && recording.run.distributed_clocks {
        inspection.suspect(format!(
            "the time of {uncertain} valid cycles is uncertain by more than {} us: the machine stalled or its clock was \
             set; `ballbard tune` shows what to do",
            UNCERTAINTY_MAX_NS / 1000
        ));
    }
    let back = cycles.windows(2).filter(|pair| pair[1].sample_time <= pair[0].sample_time).count();
    if back > 0 {
        inspection.suspect(format!("time does not increase at {back} cycles; they will be left out"));
    }
    let holes = cycles.windows(2).filter(|pair| pair[1].cycle != pair[0].cycle.wrapping_add(1)).count();
    if holes > 0 {
        inspection
            .suspect(format!("cycle numbers are not consecutive at {holes} places: records are missing"));
    }
}

/// Reports range and speed of each joint, speeds that are impossible for a bar, and joints that hardly move.
pub(super) fn motion(inspection: &mut Inspection, cycles: &[CycleRecord], encoders: &[EncoderInfo]) {
    let BarAngles { readings, measured, .. } = match bar_angles(cycles, encoders) {
        Ok(angles) => angles,
        Err(error) => return inspection.suspect(error.to_string()),
    };
    // The readings are divided at changes of the counters' origin, because angles before and after a change cannot be
    // compared. Only the longest part is inspected.
    let parts = readings.parts_within(f64::INFINITY);
    let Some(longest) = parts.into_iter().max_by_key(std::ops::Range::len) else { return };
    let kinds = std::iter::repeat(JointKind::Revolute);
    let lines = joint_lines('b', kinds, &readings.t_s[longest.clone()], &readings[longest]);
    let measured = lines.into_iter().zip(measured).filter(|(_, measured)| *measured);
    inspection.joints = measured.map(|(line, _)| line).collect();
    let jumps = |JointLine { name, speed_max, .. }: &JointLine| {
        (*speed_max > SPEED_MAX_DEG_S).then(|| format!("{name} ({speed_max:.0} deg/s)"))
    };
    inspection.suspect_joints(
        jumps,
        " moved faster than any bar does: the encoder slipped or lost counts; check its signal",
    );
    suspect_still(inspection, "check the plug");
}
