//! Detects a change during a run: parameters with a step at an unknown instant, or with a drift over the run.
//! Inputs are the residuals and the Jacobian at a solution. The result is the best significant change, if there is
//! one, and the changes that explain the residuals nearly as well. Used by `calibrate/change.rs`.
//!
//! A change adds columns to the problem. Each added column is the column of a parameter that changes, multiplied by a
//! course in time. The course is a step (zero before an instant, one from this instant on) or a ramp (from -1/2 to
//! 1/2 over the samples).
//!
//! Stages, for each alternative (a set of columns that change together):
//! 1. `WeightedRun::courses` finds the best step, first among evenly spaced instants, then among all samples near the best
//!    of them. The other course to test is the drift.
//! 2. `ChangeTest` tests whether the change is significant.
//! 3. Of all significant changes, the one with the smallest Bayesian information criterion is the best.
//! 4. `Candidate::excludes` tests which of the other steps and drifts the residuals exclude. The remaining ones are returned
//!    too.
//!
//! Notation:
//! - `C` are the added columns, `J` the columns of the estimated parameters, and `r` the residuals.
//! - `N = J'J` and `g = J'r`, both including the priors.
//! - `q = C'r - (J'C)' N^-1 g` is the score of the extended problem.
//! - `S = C'C - (J'C)' N^-1 J'C` is the information about the change (a Schur complement).
//!
//! The solution for the change is `b = -S^-1 q`, which lowers the sum of squares by `q' S^-1 q` (score test, Rao 1948). The
//! other parameters are estimated again together with the change. An uneven motion or a solve that ended early is therefore
//! not mistaken for a change.
//!
//! A change is significant relative to its own uncertainty. Residuals are not independent, because errors of gears
//! and encoders are correlated over seconds. The scatter of `q` is therefore estimated from sums over blocks of the
//! run, in two ways:
//! - `pooled`: the scatter of the blocks' scores, divided by the scatter for independent noise, and
//!   averaged over all blocks.
//! - `clustered`: the scatter of the blocks' contributions to this change (Liang and Zeger 1986). The influence of each
//!   block on the fit is removed (Bell and McCaffrey 2002). The degrees of freedom are the effective number of contributing
//!   blocks less one. This estimate is also valid if the noise varies along the run.
//!
//! Both are computed for single blocks and for groups of neighbouring blocks, to cover longer correlations. The least
//! significant of these results is used (Student's t, or Hotelling's T squared for a change of several parameters). Because
//! many instants and alternatives are tried, the rate of false alarms is divided by their number (Bonferroni).

use std::iter;
use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ContinuousCDF, FisherSnedecor};

use crate::solver::{LeastSquares, Loss, ScaledCholesky, Subset, stacked};
use crate::threads::each;

/// Highest number of blocks of a run.
const BLOCKS: usize = 128;
/// Smallest number of samples of a block.
const SAMPLES_PER_BLOCK_MIN: usize = 2;
/// Number of evenly spaced instants for the first search of a step. A second search tries every sample near the best instant.
const INSTANTS: usize = 32;
/// Numbers of neighbouring blocks that form a group. The first list is for `pooled`, the second for `clustered`. Larger
/// groups cover longer correlations, but leave fewer degrees of freedom.
const POOLED_SIZES: [usize; 4] = [1, 2, 4, 8];
const CLUSTERED_SIZES: [usize; 2] = [1, 2];
/// Smallest number of groups. The mean over fewer groups is too uncertain.
const GROUPS_MIN: usize = 15;
/// With fewer degrees of freedom of the F distribution, no change is significant.
const FREEDOM_MIN: f64 = 3.0;
/// Smallest fraction of a column's sum of squares that must be independent of the other columns.
const INDEPENDENT_MIN: f64 = 1e-4;
/// A step or drift is excluded if the best change is more likely by this factor.
const LIKELIER: f64 = 20.0;

/// Course of a change in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Course {
    /// A step. The value is the index of the first sample after the step. It is an index in the list of given samples.
    Step(usize),
    /// A ramp over the whole run.
    Drift,
}

/// A significant change of some columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    /// Index of the alternative, in the list of given alternatives.
    pub alternative: usize,
    /// Course of the change in time: a step with its instant, or a drift.
    pub course: Course,
    /// Change of each column, in the unit of its parameter. It is the height of the step, or the change from begin to
    /// end of the drift.
    pub by: Vec<f64>,
    /// Fraction by which the change reduces the squared residuals of the solution without a change.
    pub explained: f64,
}

/// Searches for a change in the given `samples` of `problem`, which are in the order of time. `x` is the solution for the
/// columns `estimated`. An alternative is a column, or a set of columns that change together.
///
/// A change is significant if a run without changes would show an equally large one with a probability of at most
/// `false_alarms`. The first of the returned changes is the significant one with the smallest Bayesian information criterion.
/// The others are the best steps and the drifts that the residuals do not exclude, in the order of the criterion.
/// Empty if no change is significant, or if there are too few samples.
pub fn change_point(
    problem: &dyn LeastSquares,
    x: &[f64],
    loss: Loss,
    samples: &[usize],
    estimated: &[usize],
    alternatives: &[Vec<usize>],
    false_alarms: f64,
) -> Vec<Change> {
    let Some(run) = WeightedRun::new(problem, x, loss, samples, estimated) else { return Vec::new() };
    // Number of tests: the evenly spaced instants of a step and the drift, for each alternative.
    let tests = (alternatives.len() * INSTANTS) as f64;
    let candidates = |alternative: usize| {
        let columns = &alternatives[alternative];
        let candidate = |course| {
            let test = ChangeTest::new(&run, columns, course)?;
            let is_significant = test.chance() * tests <= false_alarms;
            Some(Candidate {
                alternative,
                course,
                criterion: run.criterion(&test, course),
                is_significant,
                test,
            })
        };
        run.courses(columns).filter_map(candidate).collect::<Vec<_>>()
    };
    let mut candidates: Vec<Candidate> = each(alternatives.len(), candidates).into_iter().flatten().collect();
    candidates.sort_by(|a, b| a.criterion.total_cmp(&b.criterion));
    let Some(best) = candidates.iter().position(|candidate| candidate.is_significant) else {
        return Vec::new();
    };
    let best = candidates.remove(best);
    let others = candidates.iter().filter(|other| !best.excludes(other, run.groups()));
    iter::once(&best).chain(others).map(|candidate| candidate.change(&run)).collect()
}

/// A possible change, with its test.
struct Candidate {
    alternative: usize,
    course: Course,
    criterion: f64,
    is_significant: bool,
    test: ChangeTest,
}

impl Candidate {
    /// Whether this change is more likely than the other by the factor [`LIKELIER`].
    ///
    /// The logarithm of the likelihoods is divided by the overdispersion, because residuals are not independent, and the
    /// number of parameters counts as in `criterion` (QBIC, Burnham and Anderson 2002).
    fn excludes(&self, other: &Self, groups: f64) -> bool {
        let overdispersion = self.test.overdispersion();
        let squared = |candidate: &Self| {
            candidate.test.reduction / overdispersion
                - candidate.test.parameters(candidate.course) * groups.ln()
        };
        squared(self) - squared(other) > 2.0 * LIKELIER.ln()
    }

    fn change(&self, run: &WeightedRun) -> Change {
        Change {
            alternative: self.alternative,
            course: self.course,
            by: self.test.b.iter().copied().collect(),
            explained: self.test.reduction / run.squared.max(f64::MIN_POSITIVE),
        }
    }
}

/// Weighted residuals and Jacobian of a run at its solution.
struct WeightedRun {
    /// Residuals `r`, weighted by the robust loss. The Jacobian has the same weights.
    r: DVector<f64>,
    /// Jacobian of all columns of the problem. The changing columns are among them.
    jacobian: DMatrix<f64>,
    /// Jacobian `J` of the estimated columns.
    j: DMatrix<f64>,
    /// First row of each given sample, and the row after the last given sample. Rows of prior knowledge follow after these.
    first_rows: Vec<usize>,
    /// Row range of each block.
    blocks: Vec<Range<usize>>,
    /// Cholesky factor of `N`.
    n_factor: ScaledCholesky,
    /// `N^-1 g`
    n_inverse_g: DVector<f64>,
    /// Sum of squared residuals of the given samples, for a solution without a change.
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
        // Stack the rows of the given samples, followed by the samples of prior knowledge.
        let known = (0..problem.samples()).filter(|sample| problem.is_known(*sample));
        let with_known: Vec<usize> = samples.iter().copied().chain(known).collect();
        let rows: Vec<usize> = with_known.iter().map(|sample| problem.rows_of(*sample)).collect();
        let (mut r, mut jacobian) = stacked(&Subset { of: problem, samples: with_known }, x)?;
        // A sample without a value has no rows, which would shift all following rows.
        if r.len() != rows.iter().sum::<usize>() {
            return None;
        }
        // Apply the robust weights, and find the first row of each sample.
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
        // Solve for the estimated columns, with their priors.
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

    /// Courses to test for these columns: the best step and the drift. There is no step if other columns explain every step.
    fn courses(&self, columns: &[usize]) -> impl Iterator<Item = Course> {
        let samples = self.first_rows.len() - 1;
        let evenly_spaced: Vec<usize> = (1..INSTANTS).map(|part| part * samples / INSTANTS).collect();
        let spacing = samples.div_ceil(INSTANTS);
        // The second search is needed because the samples between the found and the true instant would increase the scatter.
        let near = |instant: usize| -> Vec<usize> {
            (instant.saturating_sub(spacing).max(1)..(instant + spacing).min(samples)).collect()
        };
        let coarse = self.best_step(columns, &evenly_spaced);
        let step = coarse.and_then(|instant| self.best_step(columns, &near(instant)));
        step.map(Course::Step).into_iter().chain([Course::Drift])
    }

    /// Bayesian information criterion of the solution with a change (Schwarz 1978).
    fn criterion(&self, test: &ChangeTest, course: Course) -> f64 {
        let groups = self.groups();
        let remaining = (self.squared - test.reduction).max(f64::MIN_POSITIVE);
        groups * remaining.ln() + test.parameters(course) * groups.ln()
    }

    /// Number of groups of blocks. It is used as the number of observations, because single residuals are not independent.
    fn groups(&self) -> f64 {
        (self.blocks.len() / POOLED_SIZES[POOLED_SIZES.len() - 1]) as f64
    }

    /// The added columns `C`: the changing columns multiplied by the course, with one row for each residual.
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

    /// The instant at which a step reduces the sum of squares most. `instants` are in ascending order. `None` if other
    /// columns explain every step.
    fn best_step(&self, columns: &[usize], instants: &[usize]) -> Option<usize> {
        // For a step, `C` contains the changing columns in the rows after the instant, and zeros in the rows
        // before it. The loop goes from the last instant to the first, so each iteration only adds rows to the
        // sums of the previous iteration.
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

    /// Solves the extended problem for the change `b`. `None` if other columns explain the change.
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
    /// Information `S` about the change.
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
    /// For each block, the sums for `C - J N^-1 J'C`: the changing columns without the component that `J` explains.
    of_change: Vec<BlockSums>,
    /// For each block, the sums for the changing columns themselves: without the course in time, and with the
    /// component that `J` explains.
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

    /// Number of parameters of the change. The instant of a step counts as one.
    fn parameters(&self, course: Course) -> f64 {
        self.b.len() as f64 + if course == Course::Drift { 0.0 } else { 1.0 }
    }

    /// Probability that a run without changes shows a change of at least this size at this instant. It is the largest result
    /// of `pooled` and `clustered` over all group sizes.
    fn chance(&self) -> f64 {
        let pooled = POOLED_SIZES.iter().filter_map(|group_size| self.pooled(*group_size));
        let largest = pooled.reduce(f64::max).unwrap_or(1.0);
        let enough_groups = |size: &&usize| self.of_change.len() / **size >= GROUPS_MIN;
        let clustered = CLUSTERED_SIZES.iter().filter(enough_groups).map(|size| self.clustered(*size));
        clustered.fold(largest, f64::max)
    }

    /// Significance from `pooled` in the module documentation: the scatter of the groups is compared with that of
    /// independent noise. `None` if there are too few groups.
    fn pooled(&self, group_size: usize) -> Option<f64> {
        let (ratio, freedom) = self.scatter_ratio(group_size)?;
        Some(hotelling_tail(self.reduction / ratio, self.b.len(), freedom))
    }

    /// Largest scatter of the groups' scores over all group sizes, relative to independent noise. At least 1.
    fn overdispersion(&self) -> f64 {
        let ratios = POOLED_SIZES.iter().filter_map(|group_size| self.scatter_ratio(*group_size));
        ratios.fold(1.0, |largest, (ratio, _)| largest.max(ratio))
    }

    /// Scatter of the groups' scores divided by that of independent noise of variance one, and its degrees of freedom.
    /// Groups that do not determine all changing columns are left out. For example, two positions do not
    /// determine the rotation of an instrument. `None` if too few groups remain.
    fn scatter_ratio(&self, group_size: usize) -> Option<(f64, f64)> {
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
        let freedom = scatter.len() as f64 - 1.0;
        Some((scatter.iter().sum::<f64>() / (freedom * self.b.len() as f64), freedom))
    }

    /// Significance from `clustered` in the module documentation: from the scatter of the groups'
    /// contributions to this change.
    fn clustered(&self, group_size: usize) -> f64 {
        let Some(inverse) = ScaledCholesky::new(self.information.clone()).map(|factor| factor.inverse())
        else {
            return 1.0;
        };
        let groups = sum_groups(&self.of_change, group_size);
        let (mut scatter, mut shares, mut squared_shares) = (&inverse * 0.0, 0.0, 0.0);
        for BlockSums { score, information } in &groups {
            // Leverage of the group: the fraction of the information that it contributes, averaged over the changing columns.
            let share = (&inverse * information).trace() / self.b.len() as f64;
            scatter.ger((1.0 - share).max(INDEPENDENT_MIN).powi(-2), score, score, 1.0);
            (shares, squared_shares) = (shares + share, squared_shares + share * share);
        }
        // `score` is `-q`; the sign does not matter here. `q' scatter^-1 q` is Hotelling's T squared.
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

/// Probability that Hotelling's T squared exceeds `squared`, for this number of variables and these degrees of freedom. It
/// is computed from the F distribution: `T^2 (f - p + 1) / (f p)` has an F distribution with `p` and `f - p + 1` degrees of
/// freedom, where `p` is the number of variables and `f` is `freedom`.
fn hotelling_tail(squared: f64, variables: usize, freedom: f64) -> f64 {
    let variables = variables as f64;
    let f_freedom = freedom - variables + 1.0;
    if f_freedom.is_nan() || f_freedom < FREEDOM_MIN || !squared.is_finite() {
        return 1.0;
    }
    let Ok(fisher) = FisherSnedecor::new(variables, f_freedom) else { return 1.0 };
    fisher.sf(squared.max(0.0) * f_freedom / (freedom * variables))
}
