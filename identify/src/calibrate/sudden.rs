//! What changes at one instant of a run: the zero of an encoder, or a clock. Against nominal links a small change drowns in the
//! errors of the geometry (`prepare::judge` finds the large ones); against the calibrated ones it stands out.
//!
//! A change of a parameter from an instant on is one more column of the problem: the parameter's own, zero before the
//! instant. How much the sum of squares would fall with it, everything else solved anew, follows from the normal
//! equations: `fall = (p - n' N^-1 g)^2 / (s - n' N^-1 n)` with `n = J' c`, `s = c' c`, `p = c' r`, `g = J' r`
//! (score test, Rao 1948).

use nalgebra::linalg::Cholesky;
use nalgebra::{DMatrix, DVector, Dyn};

use super::rows::Rows;
use crate::kinematics::{BAR_JOINTS, LinkParameter};
use crate::model::{Model, ParameterId};
use crate::prepare::{PrepareError, PrepareOptions, Prepared};
use crate::solver::Prior;

/// Samples to either side of an instant.
const BESIDE: usize = 20;
/// Instants that are tried at first; then all samples about the best.
const COARSE: usize = 250;
/// Part of the squared residuals that a change must take away.
const EXPLAINED: f64 = 0.5;
/// Jumps of a clock smaller than this are not looked for \[s\].
const JUMP_S_MIN: f64 = 0.002;
/// Part of a column that other columns must leave of it.
const INDEPENDENT: f64 = 1e-6;

/// What can change.
#[derive(Debug, Clone, Copy, PartialEq)]
enum What {
    /// The zero of the encoder of this joint, from 0.
    Zero(usize),
    Clock,
}

/// A change of a parameter at an instant.
#[derive(Debug, Clone, Copy)]
struct Change {
    what: What,
    /// First sample after it, among those that are looked at.
    at: usize,
    /// In the parameter's unit.
    by: f64,
    /// Of the squared residuals.
    fall: f64,
}

/// The change that a run shows, as what the preparation would have said of it.
pub(super) fn change(
    model: &Model,
    prepared: &Prepared,
    rows: &Rows,
    options: &PrepareOptions,
) -> Option<PrepareError> {
    let system = System::new(model, rows)?;
    let stride = (rows.samples.len() / COARSE).max(1);
    let coarse = system.best(|at| at.is_multiple_of(stride))?;
    let found = system.best(|at| at.abs_diff(coarse.at) <= stride)?;
    let time_s = |at: usize| Some(prepared.observations.get(rows.samples.get(at)?.0)?.t_s);
    if found.fall < EXPLAINED * rows.residuals.norm_squared() {
        return None;
    }
    // Somewhere between two samples that may be apart.
    let at_s = 0.5 * (time_s(found.at - 1)? + time_s(found.at)?) - prepared.timeline.points.first()?.t_s;
    match found.what {
        // What the encoder shows too much its zero has to take away.
        What::Zero(joint) => (found.by.abs() > options.slip_min_mrad * 1e-3)
            .then_some(PrepareError::EncoderSlip { joint: joint as u8 + 1, at_s, by_mrad: -found.by * 1e3 }),
        What::Clock => {
            (found.by.abs() > JUMP_S_MIN).then_some(PrepareError::ClockJump { at_s, by_ms: found.by * 1e3 })
        }
    }
}

/// The normal equations of a run.
struct System<'r> {
    rows: &'r Rows,
    /// A column for each row, so that a row's entries lie together.
    by_row: DMatrix<f64>,
    /// What can change, with its column.
    candidates: Vec<(What, usize)>,
    /// Of the normal matrix with columns of length one.
    factor: Cholesky<f64, Dyn>,
    lengths: DVector<f64>,
    /// `L^-1 g` of the same.
    gradient: DVector<f64>,
}

impl<'r> System<'r> {
    /// None where the run does not determine its columns.
    fn new(model: &Model, rows: &'r Rows) -> Option<Self> {
        /// Keeps combinations that only other runs determine from dividing by zero.
        const RIDGE: f64 = 1e-12;
        let candidates = candidates(model);
        let by_row = rows.jacobian.transpose();
        let mut normal = rows.jacobian.tr_mul(&rows.jacobian);
        let mut gradient = rows.jacobian.tr_mul(&rows.residuals);
        let start = model.start();
        for Prior { column, value, sigma, .. } in model.priors() {
            normal[(column, column)] += sigma.powi(-2);
            gradient[column] += (start.get(column)? - value) / sigma.powi(2);
        }
        let lengths = normal.diagonal().map(|squared| squared.sqrt().max(f64::MIN_POSITIVE));
        for (column, length) in lengths.iter().enumerate() {
            normal.column_mut(column).scale_mut(length.recip());
            normal.row_mut(column).scale_mut(length.recip());
            normal[(column, column)] += RIDGE;
        }
        let factor = normal.cholesky()?;
        let mut system = Self { rows, by_row, candidates, factor, lengths, gradient: DVector::zeros(0) };
        system.gradient = system.reduced(&gradient)?;
        Some(system)
    }

    /// `L^-1 v` for a vector of the unscaled columns.
    fn reduced(&self, v: &DVector<f64>) -> Option<DVector<f64>> {
        self.factor.l_dirty().solve_lower_triangular(&v.component_div(&self.lengths))
    }

    /// The change that takes most away, over the instants that are wanted.
    fn best(&self, wanted: impl Fn(usize) -> bool) -> Option<Change> {
        let rows_per_sample = self.rows.per_sample();
        let samples = self.rows.samples.len();
        let mut sums: Vec<Sums> = self.candidates.iter().map(|_| Sums::new(self.by_row.nrows())).collect();
        let mut best: Option<Change> = None;
        // From the end, so that the rows from an instant on are those that have been added.
        for at in (BESIDE..samples).rev() {
            for row in at * rows_per_sample..(at + 1) * rows_per_sample {
                let entries = self.by_row.column(row);
                for (sums, (_, column)) in sums.iter_mut().zip(&self.candidates) {
                    let own = entries[*column];
                    sums.n.axpy(own, &entries, 1.0);
                    sums.s += own * own;
                    sums.p += own * self.rows.residuals[row];
                }
            }
            if samples - at < BESIDE || !wanted(at) {
                continue;
            }
            let changes = sums.iter().zip(&self.candidates).filter_map(|(sums, (what, _))| {
                let (by, fall) = self.fall(sums)?;
                Some(Change { what: *what, at, by, fall })
            });
            best = changes.chain(best).max_by(|a, b| a.fall.total_cmp(&b.fall));
        }
        best
    }

    /// The best change, and by how much the sum of squares falls.
    fn fall(&self, Sums { n, s, p }: &Sums) -> Option<(f64, f64)> {
        let reduced = self.reduced(n)?;
        let stiffness = s - reduced.norm_squared();
        let pull = p - reduced.dot(&self.gradient);
        (stiffness > INDEPENDENT * s).then(|| (-pull / stiffness, pull * pull / stiffness))
    }
}

/// `n`, `s` and `p` of a column that is zero before an instant.
struct Sums {
    n: DVector<f64>,
    s: f64,
    p: f64,
}

impl Sums {
    fn new(columns: usize) -> Self {
        Self { n: DVector::zeros(columns), s: 0.0, p: 0.0 }
    }
}

fn candidates(model: &Model) -> Vec<(What, usize)> {
    let zeros = (0..BAR_JOINTS)
        .map(|joint| (What::Zero(joint), ParameterId::Bar { link: joint, parameter: LinkParameter::Theta }));
    let all = zeros.chain([(What::Clock, ParameterId::ClockShift)]);
    let column = |id: ParameterId| model.columns().position(|parameter| parameter.id == id);
    all.filter_map(|(what, id)| Some((what, column(id)?))).collect()
}
