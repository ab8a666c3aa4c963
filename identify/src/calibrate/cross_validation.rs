//! Which terms a model should have, and how strongly their priors hold them, decided by rows left out of the fit.
//!
//! Small terms enter a residual linearly, so that one pass over the rows is enough: it gives the normal equations of
//! each fold with the columns of every candidate. Solving without one fold and predicting the fold is then small linear
//! algebra, for any choice of terms and priors (the classical identity for quadratic forms; no row is looked at again).

use std::ops::AddAssign;

use nalgebra::{DMatrix, DVector};

/// Normal equations of some rows about a point: `|r + J dx|^2 = squared + 2 gradient.dx + dx.matrix dx`.
#[derive(Debug, Clone, PartialEq)]
pub struct Normal {
    /// `J^T J`
    pub matrix: DMatrix<f64>,
    /// `J^T r`
    pub gradient: DVector<f64>,
    /// `r^T r`
    pub squared: f64,
}

impl Normal {
    /// Of no rows.
    pub fn zeros(columns: usize) -> Self {
        Self { matrix: DMatrix::zeros(columns, columns), gradient: DVector::zeros(columns), squared: 0.0 }
    }

    /// Adds rows.
    pub fn add(&mut self, residual: &DVector<f64>, jacobian: &DMatrix<f64>) {
        let transposed = jacobian.transpose();
        self.matrix.gemm(1.0, &transposed, jacobian, 1.0);
        self.gradient.gemv(1.0, &transposed, residual, 1.0);
        self.squared += residual.norm_squared();
    }

    /// The same rows about a point that is a step away.
    #[must_use]
    pub fn about(&self, step: &DVector<f64>) -> Self {
        Self {
            matrix: self.matrix.clone(),
            gradient: &self.gradient + &self.matrix * step,
            squared: self.after(step),
        }
    }

    /// The same rows with some of the columns.
    fn only(&self, columns: &[usize]) -> Self {
        Self {
            matrix: self.matrix.select_rows(columns).select_columns(columns),
            gradient: self.gradient.select_rows(columns),
            squared: self.squared,
        }
    }

    fn without(&self, other: &Self) -> Self {
        Self {
            matrix: &self.matrix - &other.matrix,
            gradient: &self.gradient - &other.gradient,
            squared: self.squared - other.squared,
        }
    }

    /// Sum of squares after a step.
    pub fn after(&self, step: &DVector<f64>) -> f64 {
        self.squared + 2.0 * self.gradient.dot(step) + step.dot(&(&self.matrix * step))
    }
}

impl AddAssign<&Self> for Normal {
    fn add_assign(&mut self, other: &Self) {
        self.matrix += &other.matrix;
        self.gradient += &other.gradient;
        self.squared += other.squared;
    }
}

/// A prior on a step: it is expected to be `expected` within `sigma`; a sigma of infinity leaves it free.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepPrior {
    /// Column.
    pub column: usize,
    /// Expected step.
    pub expected: f64,
    /// Standard deviation.
    pub sigma: f64,
}

/// A candidate: columns that join the model together, with one standard deviation around zero.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Name in reports.
    pub name: String,
    /// Its columns.
    pub columns: Vec<usize>,
    /// Standard deviations to choose from, in the columns' unit.
    pub sigmas: Vec<f64>,
}

/// A candidate that was taken.
#[derive(Debug, Clone, PartialEq)]
pub struct Chosen {
    /// Place among the candidates.
    pub candidate: usize,
    /// Standard deviation of its prior.
    pub sigma: f64,
    /// Root mean square over rows left out, in standard deviations, before it was taken.
    pub rms_before: f64,
    /// And with it.
    pub rms_after: f64,
}

/// Folds, the columns that are always there, and the number of residuals.
#[derive(Debug, Clone)]
pub struct CrossValidation {
    /// Normal equations of each fold, all columns.
    pub folds: Vec<Normal>,
    /// Columns that every model has, with their priors.
    pub always: Vec<StepPrior>,
    /// Residuals in all folds together.
    pub residuals: usize,
}

/// A term is taken where it lowers the root mean square over rows left out by this part.
const GAIN_MIN: f64 = 0.005;

impl CrossValidation {
    /// Takes candidates one after the other, each time the best, as long as rows left out are predicted better; then
    /// the standard deviations of those taken are gone over once more.
    pub fn choose(&self, candidates: &[Candidate]) -> Vec<Chosen> {
        let mut chosen: Vec<Chosen> = Vec::new();
        let mut rms = self.rms(candidates, &[]);
        loop {
            let left = (0..candidates.len()).filter(|index| chosen.iter().all(|one| one.candidate != *index));
            let trials = left.flat_map(|candidate| {
                candidates[candidate].sigmas.iter().map(move |&sigma| (candidate, sigma))
            });
            let best = trials
                .filter_map(|(candidate, sigma)| {
                    let trial = Chosen { candidate, sigma, rms_before: rms?, rms_after: 0.0 };
                    let mut all = chosen.clone();
                    all.push(trial.clone());
                    Some(Chosen { rms_after: self.rms(candidates, &all)?, ..trial })
                })
                .min_by(|a, b| a.rms_after.total_cmp(&b.rms_after));
            match best {
                Some(best) if best.rms_after < (1.0 - GAIN_MIN) * best.rms_before => {
                    rms = Some(best.rms_after);
                    chosen.push(best);
                }
                _ => break,
            }
        }
        self.refine(candidates, &mut chosen);
        chosen
    }

    fn refine(&self, candidates: &[Candidate], chosen: &mut [Chosen]) {
        for index in 0..chosen.len() {
            let of = |sigma: f64| {
                let mut all = chosen.to_vec();
                all[index].sigma = sigma;
                Some((sigma, self.rms(candidates, &all)?))
            };
            let sigmas = candidates[chosen[index].candidate].sigmas.iter();
            let best = sigmas.filter_map(|&sigma| of(sigma)).min_by(|a, b| a.1.total_cmp(&b.1));
            if let Some((sigma, _)) = best {
                chosen[index].sigma = sigma;
            }
        }
    }

    /// Root mean square over all rows, each predicted without its fold; none where a solve has no answer.
    fn rms(&self, candidates: &[Candidate], chosen: &[Chosen]) -> Option<f64> {
        let (columns, priors) = self.model(candidates, chosen);
        let folds: Vec<Normal> = self.folds.iter().map(|fold| fold.only(&columns)).collect();
        let all = sum(&folds)?;
        let mut squared = 0.0;
        for fold in &folds {
            squared += fold.after(&step(&all.without(fold), &priors)?);
        }
        Some((squared / self.residuals.max(1) as f64).sqrt())
    }

    /// Columns of a model and the priors on its steps, these by place among the columns.
    fn model(&self, candidates: &[Candidate], chosen: &[Chosen]) -> (Vec<usize>, Vec<StepPrior>) {
        let taken = chosen.iter().flat_map(|one| {
            let prior = |&column: &usize| StepPrior { column, expected: 0.0, sigma: one.sigma };
            candidates[one.candidate].columns.iter().map(prior)
        });
        let mut priors: Vec<StepPrior> = self.always.iter().copied().chain(taken).collect();
        let columns = priors.iter().map(|prior| prior.column).collect();
        priors.iter_mut().enumerate().for_each(|(place, prior)| prior.column = place);
        (columns, priors)
    }
}

fn sum(folds: &[Normal]) -> Option<Normal> {
    let (first, rest) = folds.split_first()?;
    let mut all = first.clone();
    rest.iter().for_each(|fold| all += fold);
    Some(all)
}

/// The least-squares step of normal equations and priors, column-scaled; none where a column is not determined.
pub fn step(normal: &Normal, priors: &[StepPrior]) -> Option<DVector<f64>> {
    let mut matrix = normal.matrix.clone();
    let mut gradient = normal.gradient.clone();
    for prior in priors {
        let weight = prior.sigma.powi(-2);
        matrix[(prior.column, prior.column)] += weight;
        gradient[prior.column] -= weight * prior.expected;
    }
    let scale = matrix.diagonal().map(|entry| if entry > 0.0 { entry.sqrt().recip() } else { 0.0 });
    for (j, mut column) in matrix.column_iter_mut().enumerate() {
        column.component_mul_assign(&scale);
        column *= scale[j];
        // A column that no row sees stays where it is.
        if scale[j] == 0.0 {
            column[j] = 1.0;
        }
    }
    let scaled = matrix.cholesky()?.solve(&gradient.component_mul(&scale));
    Some(-scaled.component_mul(&scale))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::rngs::StdRng;
    use rand::{Rng, SeedableRng};
    use rand_distr::StandardNormal;

    /// Rows of a line with a wave that is there and one that is not.
    fn folds(noise: f64) -> CrossValidation {
        let mut random = StdRng::seed_from_u64(3);
        let folds: Vec<Normal> = (0..5)
            .map(|_| {
                let t = DVector::from_fn(40, |_, _| random.random_range(-3.0..3.0_f64));
                let jacobian = DMatrix::from_fn(40, 4, |i, j| match j {
                    0 => 1.0,
                    1 => t[i],
                    2 => (5.0 * t[i]).sin(),
                    _ => (11.0 * t[i]).cos(),
                });
                let residual = DVector::from_fn(40, |i, _| {
                    let white: f64 = random.sample(StandardNormal);
                    0.3 + 0.2 * t[i] - 0.5 * (5.0 * t[i]).sin() + noise * white
                });
                let mut normal = Normal::zeros(4);
                normal.add(&residual, &jacobian);
                normal
            })
            .collect();
        let free = |column| StepPrior { column, expected: 0.0, sigma: f64::INFINITY };
        CrossValidation { folds, always: vec![free(0), free(1)], residuals: 200 }
    }

    fn candidate(name: &str, column: usize) -> Candidate {
        Candidate { name: name.into(), columns: vec![column], sigmas: vec![0.01, 1.0] }
    }

    #[test]
    fn a_term_that_is_in_the_data_is_taken_and_one_that_is_not_is_left() {
        let chosen = folds(0.1).choose(&[candidate("absent", 3), candidate("present", 2)]);
        assert_eq!(chosen.len(), 1, "{chosen:?}");
        assert_eq!((chosen[0].candidate, chosen[0].sigma), (1, 1.0));
        assert!(chosen[0].rms_before > 0.3 && (chosen[0].rms_after - 0.1).abs() < 0.02);
    }

    #[test]
    fn a_step_with_priors_is_the_minimum_of_both_sums_of_squares() {
        let cv = folds(0.1);
        let normal = sum(&cv.folds).unwrap_or_else(|| Normal::zeros(4));
        let prior = StepPrior { column: 2, expected: 0.1, sigma: 0.05 };
        let found = step(&normal, &[prior]).unwrap_or_else(|| DVector::zeros(4));
        let cost = |x: &DVector<f64>| normal.after(x) + ((x[2] - 0.1) / 0.05).powi(2);
        for column in 0..4 {
            for by in [-1e-4, 1e-4] {
                let mut aside = found.clone();
                aside[column] += by;
                assert!(cost(&aside) > cost(&found));
            }
        }
    }
}
