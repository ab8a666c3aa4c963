//! Changes during a run: a parameter with a step at an unknown instant, or with a drift.
//!
//! A change adds columns to the problem: those of the parameters that change, each multiplied by its course in time, which is a
//! step (zero before an instant, one after it) or a ramp. With `C` these columns, `J` those of the estimated parameters,
//! `N = J'J` with the priors, `g = J'r`, `n = J'C`, `s = C'C` and `p = C'r`, the solution of the extended problem has the
//! change `b = -S^-1 (p - n' N^-1 g)`, `S = s - n' N^-1 n`. Its sum of squares is lower by
//! `(p - n' N^-1 g)' S^-1 (p - n' N^-1 g)` (score test, Rao 1948). The other parameters are estimated again with the change, so
//! neither an uneven motion nor an early end of the solve is mistaken for a change.
//!
//! A change is significant relative to its own uncertainty, and residuals are not independent: errors of gears and encoders are
//! correlated over seconds. Their scatter is therefore estimated from sums over blocks of the run, in two ways. `pooled`: ratio
//! of the scatter of the blocks' scores to that of independent noise, averaged over all blocks. `clustered`: scatter of the
//! contributions of the blocks to this change (Liang and Zeger 1986; the influence of each block on the fit is removed as by
//! Bell and McCaffrey 2002), with as many degrees of freedom as blocks contribute; it is valid if the noise varies along the
//! run. Both are computed for single blocks and for groups of neighbouring blocks, to cover longer correlations. The least
//! significant result counts (Student's t, and Hotelling's for changes of several numbers). Because all instants and
//! alternatives are tried, the rate of false alarms is divided by their number (Bonferroni).

use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ContinuousCDF, FisherSnedecor};

use crate::solver::{Loss, Problem, ScaledCholesky, Subset, stacked};
use crate::threads::each;

/// Highest number of blocks of a run.
const BLOCKS: usize = 128;
/// Least number of samples of a block, to estimate the scatter.
const SAMPLES_PER_BLOCK_MIN: usize = 2;
/// Number of evenly spaced instants of a step in the first search; the second tries each sample near the best one.
const INSTANTS: usize = 32;
/// Numbers of neighbouring blocks that form a group, for `pooled` and for `clustered`. Larger groups allow longer correlations,
/// but have fewer degrees of freedom.
const POOLED: [usize; 4] = [1, 2, 4, 8];
const CLUSTERED: [usize; 2] = [1, 2];
/// Least number of groups: the mean of fewer is too uncertain.
const GROUPS_MIN: usize = 15;
/// Least number of degrees of freedom for any significance.
const FREEDOM_MIN: f64 = 3.0;
/// Least part of a column that must be independent of the other columns.
const INDEPENDENT: f64 = 1e-4;

/// Course of a change in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Course {
    /// A step at this sample, by its index among the given samples.
    Step(usize),
    /// A ramp over the whole run.
    Drift,
}

/// A significant change of some columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    /// Index of the alternative.
    pub alternative: usize,
    /// Step with its instant, or drift.
    pub course: Course,
    /// Change of each column, in its unit: after a step, or from begin to end of a drift.
    pub by: Vec<f64>,
    /// Reduction of the squared residuals by the change, as a part of those of a solution without it.
    pub explained: f64,
}

/// The most significant change in `samples`, in the order of time, of `problem` at its solution `x` for the columns
/// `estimated`. `None` if a run without changes shows as much in more than this part `false_alarms` of runs, or if there are
/// too few samples. An alternative is one column, or several that change together.
pub fn change_point(
    problem: &dyn Problem,
    x: &[f64],
    loss: Loss,
    samples: &[usize],
    estimated: &[usize],
    alternatives: &[Vec<usize>],
    false_alarms: f64,
) -> Option<Change> {
    let run = Run::new(problem, x, loss, samples, estimated)?;
    let instants: Vec<usize> = (1..INSTANTS).map(|part| part * samples.len() / INSTANTS).collect();
    let reach = samples.len().div_ceil(INSTANTS);
    let tests = (alternatives.len() * (instants.len() + 1)) as f64;
    let of_one = |alternative: usize| {
        let columns = &alternatives[alternative];
        let mut best: Option<(f64, Change)> = None;
        // With a wrong instant, the samples between it and the right one would increase the scatter.
        let near = |at: usize| -> Vec<usize> {
            (at.saturating_sub(reach).max(1)..(at + reach).min(samples.len())).collect()
        };
        let coarse = run.best_step(columns, &instants);
        let step = coarse.and_then(|at| run.best_step(columns, &near(at))).map(Course::Step);
        for course in step.into_iter().chain([Course::Drift]) {
            let Some(tried) = Tried::new(&run, columns, course) else { continue };
            if tried.chance() * tests > false_alarms {
                continue;
            }
            // Score by the reduction, for independent blocks; the instant counts as one more parameter (Schwarz 1978).
            let groups = (run.blocks.len() / POOLED[POOLED.len() - 1]) as f64;
            let numbers = columns.len() as f64 + if course == Course::Drift { 0.0 } else { 1.0 };
            let left = (run.squared - tried.fall).max(f64::MIN_POSITIVE);
            let score = groups * left.ln() + numbers * groups.ln();
            if best.as_ref().is_none_or(|(least, _)| score < *least) {
                let explained = tried.fall / run.squared.max(f64::MIN_POSITIVE);
                let by = tried.by.iter().copied().collect();
                best = Some((score, Change { alternative, course, by, explained }));
            }
        }
        best
    };
    let found = each(alternatives.len(), of_one).into_iter().flatten();
    found.reduce(|best, other| if other.0 < best.0 { other } else { best }).map(|(_, change)| change)
}

/// Weighted residuals and Jacobian of a run.
struct Run {
    r: DVector<f64>,
    /// Jacobian of all columns.
    all: DMatrix<f64>,
    /// Jacobian of the estimated columns.
    j: DMatrix<f64>,
    /// First row of each given sample, and the end of the last one; rows of prior knowledge follow.
    first: Vec<usize>,
    /// Row range of each block.
    blocks: Vec<Range<usize>>,
    factor: ScaledCholesky,
    /// `N^-1 g`
    pulled: DVector<f64>,
    /// Squared residuals of the given samples, for a solution without a change.
    squared: f64,
}

impl Run {
    fn new(
        problem: &dyn Problem,
        x: &[f64],
        loss: Loss,
        samples: &[usize],
        estimated: &[usize],
    ) -> Option<Self> {
        let count = BLOCKS.min(samples.len() / SAMPLES_PER_BLOCK_MIN);
        if count < GROUPS_MIN {
            return None;
        }
        let known = (0..problem.samples()).filter(|sample| problem.is_known(*sample));
        let shown: Vec<usize> = samples.iter().copied().chain(known).collect();
        let rows: Vec<usize> = shown.iter().map(|sample| problem.rows_of(*sample)).collect();
        let (mut r, mut all) = stacked(&Subset { of: problem, samples: shown }, x)?;
        // A sample without a value would shift all following rows.
        if r.len() != rows.iter().sum::<usize>() {
            return None;
        }
        let mut first = vec![0];
        for (sample, rows) in rows.iter().enumerate() {
            let begin = first[sample];
            let weight =
                loss.of_rows(*rows, problem.rows()).weight(r.rows(begin, *rows).norm_squared()).sqrt();
            r.rows_mut(begin, *rows).scale_mut(weight);
            all.rows_mut(begin, *rows).scale_mut(weight);
            first.push(begin + rows);
        }
        first.truncate(samples.len() + 1);
        let border = |block: usize| first[block * samples.len() / count];
        let blocks = (0..count).map(|block| border(block)..border(block + 1)).collect();
        let j = all.select_columns(estimated);
        let (mut normal, mut gradient) = (j.tr_mul(&j), j.tr_mul(&r));
        for prior in problem.priors() {
            let Some(own) = estimated.iter().position(|column| *column == prior.column) else { continue };
            let weight = prior.sigma.powi(-2);
            normal[(own, own)] += weight;
            gradient[own] += weight * (x[prior.column] - prior.value);
        }
        let factor = ScaledCholesky::new(normal)?;
        let pulled = factor.solve(&gradient);
        let squared = r.rows(0, first[samples.len()]).norm_squared() - gradient.dot(&pulled);
        Some(Self { r, all, j, first, blocks, factor, pulled, squared })
    }

    /// The changing columns multiplied by a course, one row for each residual.
    fn changing(&self, columns: &[usize], course: Course) -> DMatrix<f64> {
        let mut c = DMatrix::zeros(self.r.len(), columns.len());
        let samples = self.first.len() - 1;
        for (sample, rows) in self.first.windows(2).enumerate() {
            let value = match course {
                Course::Step(from) => f64::from(u8::from(sample >= from)),
                Course::Drift => (sample as f64 + 0.5) / samples as f64 - 0.5,
            };
            for (own, &column) in columns.iter().enumerate() {
                for row in rows[0]..rows[1] {
                    c[(row, own)] = value * self.all[(row, column)];
                }
            }
        }
        c
    }

    /// The instant whose step reduces the squares most; `instants` ascend. `None` if other columns explain every step.
    fn best_step(&self, columns: &[usize], instants: &[usize]) -> Option<usize> {
        let c = self.changing(columns, Course::Step(0));
        let mut sums = Sums::zeros(self.j.ncols(), columns.len());
        let mut end = *self.first.last()?;
        let mut best: Option<(usize, f64)> = None;
        for &at in instants.iter().rev() {
            sums.add(self, &c, self.first[at]..end);
            end = self.first[at];
            let Some(Solved { fall, .. }) = sums.solved(self) else { continue };
            if best.is_none_or(|(_, most)| fall > most) {
                best = Some((at, fall));
            }
        }
        best.map(|(at, _)| at)
    }
}

/// Terms of a change in the normal equations.
struct Sums {
    n: DMatrix<f64>,
    s: DMatrix<f64>,
    p: DVector<f64>,
}

impl Sums {
    fn zeros(estimated: usize, columns: usize) -> Self {
        Self {
            n: DMatrix::zeros(estimated, columns),
            s: DMatrix::zeros(columns, columns),
            p: DVector::zeros(columns),
        }
    }

    fn add(&mut self, run: &Run, c: &DMatrix<f64>, rows: Range<usize>) {
        let (from, count) = (rows.start, rows.len());
        let c = c.rows(from, count);
        self.n += run.j.rows(from, count).tr_mul(&c);
        self.s += c.tr_mul(&c);
        self.p += c.tr_mul(&run.r.rows(from, count));
    }

    /// `None` if other columns explain the change.
    fn solved(&self, run: &Run) -> Option<Solved> {
        let mut taken = self.n.clone();
        for mut column in taken.column_iter_mut() {
            let solved = run.factor.solve(&column.clone_owned());
            column.copy_from(&solved);
        }
        let stiffness = &self.s - self.n.tr_mul(&taken);
        if !(0..stiffness.ncols()).all(|own| stiffness[(own, own)] > INDEPENDENT * self.s[(own, own)]) {
            return None;
        }
        let pull = &self.p - self.n.tr_mul(&run.pulled);
        let by = -ScaledCholesky::new(stiffness.clone())?.solve(&pull);
        let fall = -pull.dot(&by);
        Some(Solved { taken, stiffness, by, fall })
    }
}

/// Solution of the problem with a change.
struct Solved {
    /// `N^-1 n`
    taken: DMatrix<f64>,
    /// `S`
    stiffness: DMatrix<f64>,
    /// `b`
    by: DVector<f64>,
    /// Reduction of the squared residuals.
    fall: f64,
}

/// A change, with the contribution of each block of the run.
struct Tried {
    by: DVector<f64>,
    fall: f64,
    stiffness: DMatrix<f64>,
    /// Contribution of each block to score and stiffness of the change.
    own: Vec<(DVector<f64>, DMatrix<f64>)>,
    /// The same for the columns without a course in time.
    along: Vec<(DVector<f64>, DMatrix<f64>)>,
}

impl Tried {
    fn new(run: &Run, columns: &[usize], course: Course) -> Option<Self> {
        let c = run.changing(columns, course);
        let mut sums = Sums::zeros(run.j.ncols(), columns.len());
        sums.add(run, &c, 0..run.r.len());
        let Solved { taken, stiffness, by, fall } = sums.solved(run)?;
        let after = &run.r + &c * &by - &run.j * (&run.pulled + &taken * &by);
        let sums_of = |c: &DMatrix<f64>| {
            let block = |rows: &Range<usize>| {
                let c = c.rows(rows.start, rows.len());
                (c.tr_mul(&after.rows(rows.start, rows.len())), c.tr_mul(&c))
            };
            run.blocks.iter().map(block).collect::<Vec<_>>()
        };
        let own = sums_of(&(&c - &run.j * &taken));
        let along = sums_of(&run.changing(columns, Course::Step(0)));
        Some(Self { by, fall, stiffness, own, along })
    }

    /// Probability that a run without changes shows as much at this instant.
    fn chance(&self) -> f64 {
        let pooled = POOLED.iter().filter_map(|together| self.pooled(*together));
        let least_sure = pooled.reduce(f64::max).unwrap_or(1.0);
        let enough = |together: &&usize| self.own.len() / **together >= GROUPS_MIN;
        let clustered = CLUSTERED.iter().filter(enough).map(|together| self.clustered(*together));
        clustered.fold(least_sure, f64::max)
    }

    /// `None` if too few groups determine all numbers: two positions do not determine the rotation of an instrument.
    fn pooled(&self, together: usize) -> Option<f64> {
        let scatter: Vec<f64> = summed(&self.along, together)
            .into_iter()
            .filter_map(|(score, stiffness)| {
                let factor = ScaledCholesky::new(stiffness).filter(ScaledCholesky::is_complete)?;
                Some(score.dot(&factor.solve(&score)))
            })
            .collect();
        if scatter.len() < GROUPS_MIN {
            return None;
        }
        let count = scatter.len() as f64;
        let each = scatter.iter().sum::<f64>() / ((count - 1.0) * self.by.len() as f64);
        Some(tail(self.fall / each, self.by.len(), count - 1.0))
    }

    fn clustered(&self, together: usize) -> f64 {
        let Some(inverse) = ScaledCholesky::new(self.stiffness.clone()).map(|factor| factor.inverse()) else {
            return 1.0;
        };
        let groups = summed(&self.own, together);
        let (mut scatter, mut shares, mut squares) = (&inverse * 0.0, 0.0, 0.0);
        for (score, stiffness) in &groups {
            let share = (&inverse * stiffness).trace() / self.by.len() as f64;
            scatter.ger((1.0 - share).max(INDEPENDENT).powi(-2), score, score, 1.0);
            (shares, squares) = (shares + share, squares + share * share);
        }
        let force = &self.stiffness * &self.by;
        let Some(factor) = ScaledCholesky::new(scatter) else { return 1.0 };
        tail(force.dot(&factor.solve(&force)), self.by.len(), shares * shares / squares - 1.0)
    }
}

/// Sums over groups of this number of neighbouring blocks.
fn summed(blocks: &[(DVector<f64>, DMatrix<f64>)], together: usize) -> Vec<(DVector<f64>, DMatrix<f64>)> {
    let sum = |group: &[(DVector<f64>, DMatrix<f64>)]| {
        let mut group = group.iter().cloned();
        let first = group.next()?;
        Some(group.fold(first, |(a, b), (c, d)| (a + c, b + d)))
    };
    blocks.chunks(together).filter_map(sum).collect()
}

/// Probability that Hotelling's T squared of this number of variables exceeds `squared`.
fn tail(squared: f64, numbers: usize, freedom: f64) -> f64 {
    let numbers = numbers as f64;
    let left = freedom - numbers + 1.0;
    if left.is_nan() || left < FREEDOM_MIN || !squared.is_finite() {
        return 1.0;
    }
    let Ok(fisher) = FisherSnedecor::new(numbers, left) else { return 1.0 };
    fisher.sf(squared.max(0.0) * left / (freedom * numbers))
}
