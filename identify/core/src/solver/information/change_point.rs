//! Changes during a run: a parameter with a step at an unknown instant, or with a drift. From residuals and Jacobian at a
//! solution; used by `calibrate/change.rs`.
//!
//! A change adds columns to the problem: those of the parameters that change, each multiplied by its course in time, which is a
//! step (zero before an instant, one from it on) or a ramp (from -1/2 to 1/2, by the number of the sample). With `C` these
//! columns, `J` those of the estimated parameters, `r` the residuals, `N = J'J` and `g = J'r` (both with the priors), the
//! extended problem has the score `q = C'r - (J'C)' N^-1 g`, the information `S = C'C - (J'C)' N^-1 J'C` (a Schur complement)
//! and the solution `b = -S^-1 q` for the change. Its sum of squares is lower by `q' S^-1 q` (score test, Rao 1948). The other
//! parameters are estimated again with the change, so neither an uneven motion nor an early end of the solve is mistaken for a
//! change.
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

use crate::solver::{LeastSquares, Loss, ScaledCholesky, Subset, stacked};
use crate::threads::each;

/// Highest number of blocks of a run.
const BLOCKS: usize = 128;
/// Least number of samples of a block, to estimate the scatter.
const SAMPLES_PER_BLOCK_MIN: usize = 2;
/// Number of evenly spaced instants of a step in the first search; the second tries each sample near the best one.
const INSTANTS: usize = 32;
/// Numbers of neighbouring blocks that form a group, for `pooled` and for `clustered`. Larger groups allow longer correlations,
/// but have fewer degrees of freedom.
const POOLED_SIZES: [usize; 4] = [1, 2, 4, 8];
const CLUSTERED_SIZES: [usize; 2] = [1, 2];
/// Least number of groups: the mean of fewer is too uncertain.
const GROUPS_MIN: usize = 15;
/// Least number of degrees of freedom for any significance.
const FREEDOM_MIN: f64 = 3.0;
/// Least part of a column's sum of squares that must be independent of the other columns.
const INDEPENDENT_MIN: f64 = 1e-4;

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

/// The change in `samples`, in the order of time, of `problem` at its solution `x` for the columns `estimated`: of all
/// significant ones that with the smallest Bayesian information criterion. `None` if none is significant, or if there are too
/// few samples. A change is significant if at most the part `false_alarms` of runs without changes show as much. An alternative
/// is one column, or several that change together.
pub fn change_point(
    problem: &dyn LeastSquares,
    x: &[f64],
    loss: Loss,
    samples: &[usize],
    estimated: &[usize],
    alternatives: &[Vec<usize>],
    false_alarms: f64,
) -> Option<Change> {
    let run = WeightedRun::new(problem, x, loss, samples, estimated)?;
    // The evenly spaced instants of a step, and the drift.
    let tests = (alternatives.len() * INSTANTS) as f64;
    let best_change = |alternative: usize| {
        let columns = &alternatives[alternative];
        let mut best: Option<(f64, Change)> = None;
        for course in run.courses(columns) {
            let Some(test) = ChangeTest::new(&run, columns, course) else { continue };
            if test.chance() * tests > false_alarms {
                continue;
            }
            let criterion = run.criterion(&test, course);
            if best.as_ref().is_none_or(|(least, _)| criterion < *least) {
                let explained = test.reduction / run.squared.max(f64::MIN_POSITIVE);
                let by = test.b.iter().copied().collect();
                best = Some((criterion, Change { alternative, course, by, explained }));
            }
        }
        best
    };
    let found = each(alternatives.len(), best_change).into_iter().flatten();
    found.reduce(|best, other| if other.0 < best.0 { other } else { best }).map(|(_, change)| change)
}

/// Weighted residuals and Jacobian of a run.
struct WeightedRun {
    /// `r`, weighted by the robust loss like the Jacobian.
    r: DVector<f64>,
    /// Jacobian of all columns, of which some change.
    jacobian: DMatrix<f64>,
    /// `J`: Jacobian of the estimated columns.
    j: DMatrix<f64>,
    /// First row of each given sample, and the end of the last one; rows of prior knowledge follow.
    first_rows: Vec<usize>,
    /// Row range of each block.
    blocks: Vec<Range<usize>>,
    /// Cholesky factor of `N`.
    n_factor: ScaledCholesky,
    /// `N^-1 g`
    n_inverse_g: DVector<f64>,
    /// Squared residuals of the given samples, for a solution without a change.
    squared: f64,
}

impl WeightedRun {
    fn new(
        problem: &dyn LeastSquares,
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
        let with_known: Vec<usize> = samples.iter().copied().chain(known).collect();
        let rows: Vec<usize> = with_known.iter().map(|sample| problem.rows_of(*sample)).collect();
        let (mut r, mut jacobian) = stacked(&Subset { of: problem, samples: with_known }, x)?;
        // A sample without a value would shift all following rows.
        if r.len() != rows.iter().sum::<usize>() {
            return None;
        }
        let mut first_rows = vec![0];
        for (sample, rows) in rows.iter().enumerate() {
            let begin = first_rows[sample];
            let squared = r.rows(begin, *rows).norm_squared();
            let weight = loss.of_rows(*rows, problem.rows()).weight(squared).sqrt();
            r.rows_mut(begin, *rows).scale_mut(weight);
            jacobian.rows_mut(begin, *rows).scale_mut(weight);
            first_rows.push(begin + rows);
        }
        first_rows.truncate(samples.len() + 1);
        let border = |block: usize| first_rows[block * samples.len() / count];
        let blocks = (0..count).map(|block| border(block)..border(block + 1)).collect();
        let j = jacobian.select_columns(estimated);
        let (mut n, mut g) = (j.tr_mul(&j), j.tr_mul(&r));
        for prior in problem.priors() {
            let Some(place) = estimated.iter().position(|column| *column == prior.column) else { continue };
            let weight = prior.sigma.powi(-2);
            n[(place, place)] += weight;
            g[place] += weight * (x[prior.column] - prior.value);
        }
        let n_factor = ScaledCholesky::new(n)?;
        let n_inverse_g = n_factor.solve(&g);
        let squared = r.rows(0, first_rows[samples.len()]).norm_squared() - g.dot(&n_inverse_g);
        Some(Self { r, jacobian, j, first_rows, blocks, n_factor, n_inverse_g, squared })
    }

    /// The best step of these columns, unless other columns explain every step, and the drift.
    fn courses(&self, columns: &[usize]) -> impl Iterator<Item = Course> {
        let samples = self.first_rows.len() - 1;
        let evenly_spaced: Vec<usize> = (1..INSTANTS).map(|part| part * samples / INSTANTS).collect();
        let spacing = samples.div_ceil(INSTANTS);
        // With a wrong instant, the samples between it and the right one would increase the scatter.
        let near = |instant: usize| -> Vec<usize> {
            (instant.saturating_sub(spacing).max(1)..(instant + spacing).min(samples)).collect()
        };
        let coarse = self.best_step(columns, &evenly_spaced);
        let step = coarse.and_then(|instant| self.best_step(columns, &near(instant)));
        step.map(Course::Step).into_iter().chain([Course::Drift])
    }

    /// Bayesian information criterion of the solution with a change, for independent groups of blocks; the instant of a step
    /// counts as one more parameter (Schwarz 1978).
    fn criterion(&self, test: &ChangeTest, course: Course) -> f64 {
        let groups = (self.blocks.len() / POOLED_SIZES[POOLED_SIZES.len() - 1]) as f64;
        let parameters = test.b.len() as f64 + if course == Course::Drift { 0.0 } else { 1.0 };
        let remaining = (self.squared - test.reduction).max(f64::MIN_POSITIVE);
        groups * remaining.ln() + parameters * groups.ln()
    }

    /// `C`: the changing columns multiplied by a course, one row for each residual.
    fn changing_columns(&self, columns: &[usize], course: Course) -> DMatrix<f64> {
        let mut c = DMatrix::zeros(self.r.len(), columns.len());
        let samples = self.first_rows.len() - 1;
        for (sample, rows) in self.first_rows.windows(2).enumerate() {
            let value = match course {
                Course::Step(instant) => f64::from(u8::from(sample >= instant)),
                Course::Drift => (sample as f64 + 0.5) / samples as f64 - 0.5,
            };
            for (place, &column) in columns.iter().enumerate() {
                for row in rows[0]..rows[1] {
                    c[(row, place)] = value * self.jacobian[(row, column)];
                }
            }
        }
        c
    }

    /// The instant whose step reduces the squares most; `instants` ascend. `None` if other columns explain every step.
    fn best_step(&self, columns: &[usize], instants: &[usize]) -> Option<usize> {
        // A step at an instant has these columns in the rows after it, so its sums grow from the last instant to the first.
        let c = self.changing_columns(columns, Course::Step(0));
        let mut sums = ChangeSums::zeros(self.j.ncols(), columns.len());
        let mut end = *self.first_rows.last()?;
        let mut best: Option<(usize, f64)> = None;
        for &instant in instants.iter().rev() {
            sums.add(self, &c, self.first_rows[instant]..end);
            end = self.first_rows[instant];
            let Some(ChangeSolution { reduction, .. }) = sums.solve(self) else { continue };
            if best.is_none_or(|(_, most)| reduction > most) {
                best = Some((instant, reduction));
            }
        }
        best.map(|(instant, _)| instant)
    }
}

/// Terms of a change in the normal equations: `J'C`, `C'C` and `C'r`.
struct ChangeSums {
    jc: DMatrix<f64>,
    cc: DMatrix<f64>,
    cr: DVector<f64>,
}

impl ChangeSums {
    fn zeros(estimated: usize, columns: usize) -> Self {
        Self {
            jc: DMatrix::zeros(estimated, columns),
            cc: DMatrix::zeros(columns, columns),
            cr: DVector::zeros(columns),
        }
    }

    fn add(&mut self, run: &WeightedRun, c: &DMatrix<f64>, rows: Range<usize>) {
        let (from, count) = (rows.start, rows.len());
        let c = c.rows(from, count);
        self.jc += run.j.rows(from, count).tr_mul(&c);
        self.cc += c.tr_mul(&c);
        self.cr += c.tr_mul(&run.r.rows(from, count));
    }

    /// The solution `b` of the extended problem; `None` if other columns explain the change.
    fn solve(&self, run: &WeightedRun) -> Option<ChangeSolution> {
        let mut n_inverse_jc = self.jc.clone();
        for mut column in n_inverse_jc.column_iter_mut() {
            let solved = run.n_factor.solve(&column.clone_owned());
            column.copy_from(&solved);
        }
        let information = &self.cc - self.jc.tr_mul(&n_inverse_jc);
        let is_independent = |k: usize| information[(k, k)] > INDEPENDENT_MIN * self.cc[(k, k)];
        if !(0..information.ncols()).all(is_independent) {
            return None;
        }
        let score = &self.cr - self.jc.tr_mul(&run.n_inverse_g);
        let b = -ScaledCholesky::new(information.clone())?.solve(&score);
        let reduction = -score.dot(&b);
        Some(ChangeSolution { n_inverse_jc, information, b, reduction })
    }
}

/// Solution of the problem with a change.
struct ChangeSolution {
    /// `N^-1 J'C`
    n_inverse_jc: DMatrix<f64>,
    /// `S`
    information: DMatrix<f64>,
    /// Change of each column.
    b: DVector<f64>,
    /// Reduction of the squared residuals: `q' S^-1 q`.
    reduction: f64,
}

/// Contribution of one block of the run, or of a group of blocks, to score and information of some columns `c`.
struct BlockSums {
    /// `c'r`, with the residuals of the solution with the change.
    score: DVector<f64>,
    /// `c'c`
    information: DMatrix<f64>,
}

/// Significance test of a change, from the contribution of each block of the run.
struct ChangeTest {
    b: DVector<f64>,
    reduction: f64,
    information: DMatrix<f64>,
    /// Blocks of the changing columns without the part that `J` explains: `C - J N^-1 J'C`.
    of_change: Vec<BlockSums>,
    /// Blocks of the same columns without a course in time, with the part that `J` explains.
    of_columns: Vec<BlockSums>,
}

impl ChangeTest {
    fn new(run: &WeightedRun, columns: &[usize], course: Course) -> Option<Self> {
        let c = run.changing_columns(columns, course);
        let mut sums = ChangeSums::zeros(run.j.ncols(), columns.len());
        sums.add(run, &c, 0..run.r.len());
        let ChangeSolution { n_inverse_jc, information, b, reduction } = sums.solve(run)?;
        let residuals = &run.r + &c * &b - &run.j * (&run.n_inverse_g + &n_inverse_jc * &b);
        let block_sums = |c: &DMatrix<f64>| {
            let block = |rows: &Range<usize>| {
                let c = c.rows(rows.start, rows.len());
                let score = c.tr_mul(&residuals.rows(rows.start, rows.len()));
                BlockSums { score, information: c.tr_mul(&c) }
            };
            run.blocks.iter().map(block).collect::<Vec<_>>()
        };
        let of_change = block_sums(&(&c - &run.j * &n_inverse_jc));
        let of_columns = block_sums(&run.changing_columns(columns, Course::Step(0)));
        Some(Self { b, reduction, information, of_change, of_columns })
    }

    /// Probability that a run without changes shows as much at this instant.
    fn chance(&self) -> f64 {
        let pooled = POOLED_SIZES.iter().filter_map(|group_size| self.pooled(*group_size));
        let largest = pooled.reduce(f64::max).unwrap_or(1.0);
        let enough_groups = |size: &&usize| self.of_change.len() / **size >= GROUPS_MIN;
        let clustered = CLUSTERED_SIZES.iter().filter(enough_groups).map(|size| self.clustered(*size));
        clustered.fold(largest, f64::max)
    }

    /// Significance by the ratio of the groups' scatter to that of independent noise (`pooled` above). `None` if too few groups
    /// determine all numbers: two positions do not determine the rotation of an instrument.
    fn pooled(&self, group_size: usize) -> Option<f64> {
        let scatter: Vec<f64> = sum_groups(&self.of_columns, group_size)
            .into_iter()
            .filter_map(|BlockSums { score, information }| {
                let factor = ScaledCholesky::new(information).filter(ScaledCholesky::is_complete)?;
                Some(score.dot(&factor.solve(&score)))
            })
            .collect();
        if scatter.len() < GROUPS_MIN {
            return None;
        }
        let count = scatter.len() as f64;
        // One for independent noise of variance one.
        let overdispersion = scatter.iter().sum::<f64>() / ((count - 1.0) * self.b.len() as f64);
        Some(hotelling_tail(self.reduction / overdispersion, self.b.len(), count - 1.0))
    }

    /// Significance by the scatter of the groups' contributions to this change (`clustered` above).
    fn clustered(&self, group_size: usize) -> f64 {
        let Some(inverse) = ScaledCholesky::new(self.information.clone()).map(|factor| factor.inverse())
        else {
            return 1.0;
        };
        let groups = sum_groups(&self.of_change, group_size);
        let (mut scatter, mut shares, mut squared_shares) = (&inverse * 0.0, 0.0, 0.0);
        for BlockSums { score, information } in &groups {
            // Leverage of the group: the part of the information that it contributes, averaged over the changing columns.
            let share = (&inverse * information).trace() / self.b.len() as f64;
            scatter.ger((1.0 - share).max(INDEPENDENT_MIN).powi(-2), score, score, 1.0);
            (shares, squared_shares) = (shares + share, squared_shares + share * share);
        }
        // `-q`, so that `q' scatter^-1 q` is Hotelling's T squared.
        let score = &self.information * &self.b;
        let Some(factor) = ScaledCholesky::new(scatter) else { return 1.0 };
        let effective_groups = shares * shares / squared_shares;
        hotelling_tail(score.dot(&factor.solve(&score)), self.b.len(), effective_groups - 1.0)
    }
}

/// Sums over groups of `group_size` neighbouring blocks.
fn sum_groups(blocks: &[BlockSums], group_size: usize) -> Vec<BlockSums> {
    let sum = |group: &[BlockSums]| BlockSums {
        score: group.iter().map(|block| &block.score).sum(),
        information: group.iter().map(|block| &block.information).sum(),
    };
    blocks.chunks(group_size).map(sum).collect()
}

/// Probability that Hotelling's T squared of this number of variables exceeds `squared`, from its F distribution.
fn hotelling_tail(squared: f64, variables: usize, freedom: f64) -> f64 {
    let variables = variables as f64;
    let f_freedom = freedom - variables + 1.0;
    if f_freedom.is_nan() || f_freedom < FREEDOM_MIN || !squared.is_finite() {
        return 1.0;
    }
    let Ok(fisher) = FisherSnedecor::new(variables, f_freedom) else { return 1.0 };
    fisher.sf(squared.max(0.0) * f_freedom / (freedom * variables))
}
