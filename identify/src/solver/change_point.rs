//! What changes during a run: a parameter that steps at an unknown instant, or drifts.
//!
//! A change is a few more columns of the problem, those of the parameters that change, each times a course in time: zero
//! before an instant and one from it on, or a ramp. With `n = J' c`, `s = c' c`, `p = c' r` and `g = J' r` the problem solved
//! anew with it has the change `-S^-1 (p - n' N^-1 g)`, `S = s - n' N^-1 n`, and `(p - n' N^-1 g)^2 / S` less squares (score
//! test, Rao 1948): all else that is free takes its share first, so that neither an uneven motion nor a solve that ended early
//! passes for a change.
//!
//! Whether it is one, its own uncertainty decides, and residuals are not independent: errors of gears and encoders last for
//! seconds. So their scatter is measured, not assumed, from the sums over blocks of the run, in two ways. `pooled`: how much
//! more the blocks' scores scatter than independent noise does, in the mean of all blocks. `clustered`: the scatter of what
//! each block adds to this change (Liang and Zeger 1986, each block's pull on the fit taken out as by Bell and McCaffrey 2002),
//! with as many degrees of freedom as blocks share in it; it holds where the noise is not the same all along. Each is taken of
//! blocks and of several neighbours as one, for errors that last longer, and the one that is least sure of the change counts
//! (Student's t, and Hotelling's for changes of several numbers). All instants and alternatives are tried, so each has its
//! part of the rate of false alarms (Bonferroni).

use std::iter;
use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use statrs::distribution::{ContinuousCDF, FisherSnedecor};

use super::{Loss, Normal, Normals, Options, Problem, ScaledCholesky};

/// Blocks of a run: a step is sought at their borders, then between the samples beside the best one.
const BLOCKS: usize = 128;
/// Of fewer samples their scatter would be measured too ill.
const SAMPLES_PER_BLOCK_MIN: usize = 2;
/// Neighbouring blocks that are taken as one, for the mean over all blocks and for those that share in a change: the more, the
/// longer errors may last, and the fewer degrees of freedom are left.
const POOLED: [usize; 4] = [1, 2, 4, 8];
const CLUSTERED: [usize; 2] = [1, 2];
/// With less nothing is certain.
const FREEDOM_MIN: f64 = 3.0;
/// Part of a column that other columns must leave of it.
const INDEPENDENT: f64 = 1e-6;

/// How a change goes on in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Course {
    /// From this sample on, by its place among those that were looked at.
    Step(usize),
    /// Evenly over the run.
    Drift,
}

/// What changed.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    /// Which of the alternatives.
    pub alternative: usize,
    /// When.
    pub course: Course,
    /// By how much each of its directions, in the columns' units: after a step, or from begin to end.
    pub by: Vec<f64>,
}

/// The change that `samples`, in the order of time, show of `problem` at `x`; none where a sound run shows as much more often
/// than in this part `false_alarms` of runs. An alternative is one direction or several; a direction is columns that change
/// alike.
pub fn change_point(
    problem: &impl Problem,
    x: &[f64],
    loss: Loss,
    samples: &[usize],
    alternatives: &[Vec<Vec<usize>>],
    false_alarms: f64,
) -> Option<Change> {
    if samples.len() < SAMPLES_PER_BLOCK_MIN * BLOCKS {
        return None;
    }
    let borders: Vec<usize> = (0..=BLOCKS).map(|block| block * samples.len() / BLOCKS).collect();
    let blocks: Vec<Range<usize>> = borders.windows(2).map(|pair| pair[0]..pair[1]).collect();
    let run = Run::new(problem, x, loss, samples, &blocks)?;
    let mut best: Option<(f64, Change)> = None;
    let tests = (alternatives.len() * BLOCKS) as f64;
    for (alternative, directions) in alternatives.iter().enumerate() {
        let step = run.best_step(directions);
        let step = step.map(|block| (Course::Step(blocks[block].start), stepped(BLOCKS, block)));
        for (course, values) in step.into_iter().chain([(Course::Drift, ramp(BLOCKS))]) {
            let Some(tried) = Tried::new(&run, directions, &values) else { continue };
            if tried.chance() * tests > false_alarms {
                continue;
            }
            // By what each explains, as independent blocks would have it; the instant is one more number (Schwarz 1978).
            let groups = (BLOCKS / POOLED[POOLED.len() - 1]) as f64;
            let numbers = directions.len() as f64 + if course == Course::Drift { 0.0 } else { 1.0 };
            let left = (run.whole.squared - tried.fall).max(f64::MIN_POSITIVE);
            let score = groups * left.ln() + numbers * groups.ln();
            if best.as_ref().is_none_or(|(least, _)| score < *least) {
                let by = tried.by.iter().copied().collect();
                best = Some((score, Change { alternative, course, by }));
            }
        }
    }
    let (_, mut change) = best?;
    if let Course::Step(at) = change.course {
        let reach = samples.len().div_ceil(BLOCKS) + 1;
        let near = at.saturating_sub(reach)..(at + reach).min(samples.len());
        let (before, after) = (0..near.start, near.end..samples.len());
        let singles = near.clone().map(|at| at..at + 1);
        let parts: Vec<Range<usize>> = iter::once(before).chain(singles).chain(iter::once(after)).collect();
        let fine = Run::new(problem, x, loss, samples, &parts)?;
        let directions = &alternatives[change.alternative];
        let best = fine.best_step(directions)?;
        let tried = Tried::new(&fine, directions, &stepped(parts.len(), best))?;
        change.course = Course::Step(parts[best].start);
        change.by = tried.by.iter().copied().collect();
    }
    Some(change)
}

/// A step before block `at`.
fn stepped(blocks: usize, at: usize) -> Vec<f64> {
    (0..blocks).map(|block| if block < at { 0.0 } else { 1.0 }).collect()
}

/// From minus to plus a half.
fn ramp(blocks: usize) -> Vec<f64> {
    (0..blocks).map(|block| (block as f64 + 0.5) / blocks as f64 - 0.5).collect()
}

/// A run block by block.
struct Run {
    blocks: Normals,
    whole: Normal,
    factor: ScaledCholesky,
    /// `N^-1 g`
    pulled: DVector<f64>,
}

impl Run {
    fn new(
        problem: &impl Problem,
        x: &[f64],
        loss: Loss,
        samples: &[usize],
        blocks: &[Range<usize>],
    ) -> Option<Self> {
        /// Keeps combinations that only other runs determine from dividing by zero.
        const RIDGE: f64 = 1e-12;
        let of_block: Vec<Vec<usize>> = blocks.iter().map(|block| samples[block.clone()].to_vec()).collect();
        let blocks = Normals::new(problem, x, &Options { loss, ..Options::default() }, &of_block)?;
        let whole = blocks.whole();
        let factor = ScaledCholesky::damped(whole.matrix.clone(), &whole.matrix.diagonal(), RIDGE)?;
        let pulled = factor.solve(&whole.gradient);
        Some(Self { blocks, whole, factor, pulled })
    }

    /// First block after the step that takes most squares away; none where every one is taken by other columns.
    fn best_step(&self, directions: &[Vec<usize>]) -> Option<usize> {
        let blocks = self.blocks.of_folds();
        let mut sums = Sums::zeros(self.pulled.len(), directions.len());
        let mut best: Option<(usize, f64)> = None;
        for (at, block) in blocks.iter().enumerate().skip(1).rev() {
            sums.add(block, directions, 1.0);
            let Some((_, _, fall)) = sums.solved(self) else { continue };
            if best.is_none_or(|(_, most)| fall > most) {
                best = Some((at, fall));
            }
        }
        best.map(|(at, _)| at)
    }
}

/// What a change adds to the normal equations.
struct Sums {
    n: DMatrix<f64>,
    s: DMatrix<f64>,
    p: DVector<f64>,
}

impl Sums {
    fn zeros(columns: usize, directions: usize) -> Self {
        Self {
            n: DMatrix::zeros(columns, directions),
            s: DMatrix::zeros(directions, directions),
            p: DVector::zeros(directions),
        }
    }

    fn add(&mut self, block: &Normal, directions: &[Vec<usize>], course: f64) {
        for (j, direction) in directions.iter().enumerate() {
            for &column in direction {
                self.n.column_mut(j).axpy(course, &block.matrix.column(column), 1.0);
                self.p[j] += course * block.gradient[column];
            }
        }
        self.s += course * course * between(&block.matrix, directions);
    }

    /// `S`, the change and the squares that it takes away; none where other columns leave nothing of it.
    fn solved(&self, run: &Run) -> Option<(DMatrix<f64>, DVector<f64>, f64)> {
        let mut left = self.s.clone();
        for (j, n) in self.n.column_iter().enumerate() {
            let pulled = run.factor.solve(&n.clone_owned());
            left.set_column(j, &(self.s.column(j) - self.n.tr_mul(&pulled)));
        }
        let remains = |j: usize| left[(j, j)] > INDEPENDENT * self.s[(j, j)];
        if !(0..left.ncols()).all(remains) {
            return None;
        }
        let pull = &self.p - self.n.tr_mul(&run.pulled);
        let by = -ScaledCholesky::new(left.clone())?.solve(&pull);
        let fall = -pull.dot(&by);
        Some((left, by, fall))
    }
}

/// `E' N E`, the columns of `E` being sums of columns.
fn between(matrix: &DMatrix<f64>, directions: &[Vec<usize>]) -> DMatrix<f64> {
    DMatrix::from_fn(directions.len(), directions.len(), |i, j| {
        let pairs = directions[i].iter().flat_map(|a| directions[j].iter().map(move |b| (*a, *b)));
        pairs.map(|pair| matrix[pair]).sum()
    })
}

/// A change with the run solved anew.
struct Tried {
    by: DVector<f64>,
    fall: f64,
    stiffness: DMatrix<f64>,
    /// What each block adds to the change's score and to its stiffness.
    own: Vec<(DVector<f64>, DMatrix<f64>)>,
    /// The same of the direction all along, as if it did not change.
    along: Vec<(DVector<f64>, DMatrix<f64>)>,
}

impl Tried {
    fn new(run: &Run, directions: &[Vec<usize>], course: &[f64]) -> Option<Self> {
        let blocks = run.blocks.of_folds();
        let mut sums = Sums::zeros(run.pulled.len(), directions.len());
        blocks.iter().zip(course).for_each(|(block, course)| sums.add(block, directions, *course));
        let (stiffness, by, fall) = sums.solved(run)?;
        let mut taken = sums.n.clone();
        for (j, n) in sums.n.column_iter().enumerate() {
            taken.set_column(j, &run.factor.solve(&n.clone_owned()));
        }
        let moved = -(&run.pulled + &taken * &by);
        let unit = |course: f64| {
            let mut unit = DMatrix::zeros(run.pulled.len(), directions.len());
            for (j, direction) in directions.iter().enumerate() {
                direction.iter().for_each(|&column| unit[(column, j)] = course);
            }
            unit
        };
        let whole = unit(1.0);
        let mut tried = Self { by, fall, stiffness, own: Vec::new(), along: Vec::new() };
        for (block, &course) in blocks.iter().zip(course) {
            let changes = unit(course);
            let gradient = &block.gradient + &block.matrix * (&moved + &changes * &tried.by);
            let own = changes - &taken;
            tried.own.push((own.tr_mul(&gradient), own.tr_mul(&(&block.matrix * &own))));
            tried.along.push((whole.tr_mul(&gradient), between(&block.matrix, directions)));
        }
        Some(tried)
    }

    /// How likely a sound run shows as much at this instant.
    fn chance(&self) -> f64 {
        let pooled = POOLED.iter().map(|together| self.pooled(*together));
        let clustered = CLUSTERED.iter().map(|together| self.clustered(*together));
        pooled.chain(clustered).fold(0.0, f64::max)
    }

    fn pooled(&self, together: usize) -> f64 {
        let scatter: Vec<f64> = summed(&self.along, together)
            .into_iter()
            .filter_map(|(score, stiffness)| {
                let factor = ScaledCholesky::new(stiffness).filter(ScaledCholesky::is_complete)?;
                Some(score.dot(&factor.solve(&score)))
            })
            .collect();
        let count = scatter.len() as f64;
        let each = scatter.iter().sum::<f64>() / ((count - 1.0) * self.by.len() as f64);
        tail(self.fall / each, self.by.len(), count - 1.0)
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

/// So many neighbours as one.
fn summed(blocks: &[(DVector<f64>, DMatrix<f64>)], together: usize) -> Vec<(DVector<f64>, DMatrix<f64>)> {
    let sum = |group: &[(DVector<f64>, DMatrix<f64>)]| {
        let mut group = group.iter().cloned();
        let first = group.next()?;
        Some(group.fold(first, |(a, b), (c, d)| (a + c, b + d)))
    };
    blocks.chunks(together).filter_map(sum).collect()
}

/// Probability that Hotelling's T squared of so many numbers is larger.
fn tail(squared: f64, numbers: usize, freedom: f64) -> f64 {
    let numbers = numbers as f64;
    let left = freedom - numbers + 1.0;
    if left.is_nan() || left < FREEDOM_MIN || !squared.is_finite() {
        return 1.0;
    }
    let Ok(fisher) = FisherSnedecor::new(numbers, left) else { return 1.0 };
    fisher.sf(squared.max(0.0) * left / (freedom * numbers))
}
