//! Identifiability of the free parameters at a point: rank, singular values and groups of dependent parameters. They
//! are computed from an orthogonal factorisation of the Jacobian. Each solve ends with this analysis; it is also used
//! alone for the selection of parameters and poses.
//!
//! A prior determines its parameter, however wide the prior and however exact the samples are. Let `J_f` be the samples'
//! columns without prior, `J_p` those with a prior, and `P` the weights of the priors. The rank of `[J_f J_p; 0 P]` is the
//! rank of `J_f` plus the number of columns with a prior. The rank therefore depends neither on the noise nor on the number
//! of samples. A parameter that the samples hardly determine has a large standard deviation instead.
//!
//! Columns are first scaled to unit length, so that metres, radians and seconds are comparable. The singular values show the
//! rank and the size of its gap. The null space shows which parameters depend on each other.

use std::collections::BTreeSet;

use nalgebra::{DMatrix, DVector};

use super::covariance::Covariance;
use super::null_space::dependent_groups;
use crate::solver::pass::{Pass, PassError, SampleFit, Taking, Triangle};
use crate::solver::{LeastSquares, Observability, Options, Prior, SolveError};

/// Parameters that are only determined in combinations.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DependentGroup {
    /// Columns, ascending.
    pub columns: Vec<usize>,
    /// Number of columns that must be fixed so that the other columns are determined.
    pub excess: usize,
}

/// Rank of a problem with samples and priors, and its undetermined parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Identifiability {
    /// Names of the columns.
    pub names: Vec<String>,
    /// Standard deviation of the prior of each column; `None` for a column without prior.
    pub prior_sigmas: Vec<Option<f64>>,
    /// Rank from samples and priors.
    pub rank: usize,
    /// Rank from samples without priors.
    pub rank_of_samples: usize,
    /// Singular values of the column-scaled Jacobian (samples and priors), descending.
    pub singular_values: Vec<f64>,
    /// Columns without effect on the residuals.
    pub zero_columns: Vec<usize>,
    /// Groups of columns that depend on each other, smallest groups first.
    pub groups: Vec<DependentGroup>,
    /// The triangular factor `R` of the samples' weighted Jacobian, with `R^T R = J^T J`.
    pub triangle: DMatrix<f64>,
    /// Number of samples in use.
    pub samples: usize,
}

/// Some free parameters are not determined by the samples.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "only {rank} of {columns} free parameters are identified; not identified: {what}. Fix some of these (`--fix {fix}`), \
     give them a prior, or measure more varied poses"
)]
pub struct Unidentifiable {
    /// Number of identified parameters.
    pub rank: usize,
    /// Number of free parameters.
    pub columns: usize,
    /// Names of the parameters that are not identified.
    pub what: String,
    /// Names of parameters that the user can fix so that the remaining ones are determined. The text is the value
    /// of the option `--fix`.
    pub fix: String,
}

impl Identifiability {
    /// Whether every free parameter is determined.
    pub fn is_full(&self) -> bool {
        self.rank == self.names.len()
    }

    /// Ratio of the smallest nonzero singular value to the largest one that counts as zero. The larger the ratio, the
    /// more certain is the rank. `None` at full rank.
    pub fn gap(&self) -> Option<f64> {
        let smallest = self.singular_values.get(self.rank.checked_sub(1)?)?;
        Some(smallest / self.singular_values.get(self.rank)?)
    }

    /// Ratio of the smallest nonzero singular value to the largest, which is the inverse of the condition number.
    pub fn weakest(&self) -> f64 {
        let last = self.rank.checked_sub(1).and_then(|i| self.singular_values.get(i));
        match (last, self.singular_values.first()) {
            (Some(last), Some(first)) if *first > 0.0 => last / first,
            _ => 0.0,
        }
    }

    /// Observability indices of the samples without priors, with columns in the given units.
    pub fn observability(&self, units: &[f64]) -> Observability {
        Observability::new(&self.triangle, units, self.samples, 1e-9)
    }

    /// Finds combinations of `columns` that the priors determine better than all other data do. Returns the columns of
    /// these combinations in groups; a group can be a single column. All `columns` have priors. The other data are the
    /// samples and the priors of columns not in `columns`.
    ///
    /// Let `S` be the information of the other data about `columns`, in units of the priors' standard deviations. `S` is the
    /// Schur complement of the normal matrix. In directions with an eigenvalue of `S` below one, the solution follows the
    /// priors. The groups are those of [`combined`] for these directions.
    pub fn by_priors(&self, columns: &[usize]) -> Vec<Vec<usize>> {
        let others: Vec<usize> = (0..self.names.len()).filter(|column| !columns.contains(column)).collect();
        let sigma = |column: &usize| self.prior_sigmas.get(*column).copied().flatten();
        let priors_of_others = others
            .iter()
            .enumerate()
            .filter_map(|(place, column)| Some(Prior { column: place, value: 0.0, sigma: sigma(column)? }));
        let priors_of_others: Vec<Prior> = priors_of_others.collect();
        // The other columns come first. The last rows of the triangle are then a square root of the Schur complement.
        let order = [&others[..], columns].concat();
        let mut triangle = with_priors(priors_of_others.iter(), &self.triangle.select_columns(&order));
        let first = others.len();
        if triangle.nrows() <= first {
            return if columns.is_empty() { Vec::new() } else { vec![columns.to_vec()] };
        }
        for (place, column) in columns.iter().enumerate() {
            triangle.column_mut(first + place).scale_mut(sigma(column).unwrap_or(1.0));
        }
        let root = triangle.view_range(first.., first..).into_owned();
        let groups = combined(root.tr_mul(&root), |information| information < 1.0);
        let numbered = |group: Vec<usize>| group.into_iter().map(|i| columns[i]).collect();
        groups.into_iter().map(numbered).collect()
    }

    /// Columns that are not determined, either because they are zero or because they belong to a dependent group.
    pub fn undetermined(&self) -> Vec<usize> {
        let mut columns = self.zero_columns.clone();
        columns.extend(self.groups.iter().flat_map(|group| group.columns.iter().copied()));
        columns.sort_unstable();
        columns.dedup();
        columns
    }

    /// Checks that every free parameter is determined.
    ///
    /// # Errors
    /// [`Unidentifiable`] with the zero columns and the dependent groups.
    pub fn require_full(&self) -> Result<(), Unidentifiable> {
        if self.is_full() {
            return Ok(());
        }
        let of_groups = self.groups.iter().flat_map(|group| group.columns.iter().take(group.excess));
        let fix: Vec<usize> = self.zero_columns.iter().chain(of_groups).copied().collect();
        // Options name a parameter without the index of the run, which follows `@`.
        let names = fix.iter().filter_map(|column| self.name(*column).split('@').next());
        let names: BTreeSet<&str> = names.collect();
        let (what, fix) = (self.describe(), names.into_iter().collect::<Vec<_>>().join(","));
        Err(Unidentifiable { rank: self.rank, columns: self.names.len(), what, fix })
    }

    fn name(&self, column: usize) -> &str {
        self.names.get(column).map_or("?", String::as_str)
    }

    fn join(&self, columns: &[usize], separator: &str) -> String {
        columns.iter().map(|&column| self.name(column)).collect::<Vec<_>>().join(separator)
    }

    fn describe(&self) -> String {
        let mut parts = Vec::new();
        if !self.zero_columns.is_empty() {
            parts.push(format!("without effect {}", self.join(&self.zero_columns, ", ")));
        }
        for group in &self.groups {
            parts.push(format!("dependent {} (fix {})", self.join(&group.columns, "|"), group.excess));
        }
        parts.join("; ")
    }
}

/// Groups of columns that some eigenvectors of a symmetric matrix combine: those whose eigenvalues fulfil `is_used`. Let `P`
/// be the projection onto these eigenvectors. Columns `i` and `j` belong to one group if the entry `P_ij` is not zero.
pub fn combined(symmetric: DMatrix<f64>, is_used: impl Fn(f64) -> bool) -> Vec<Vec<usize>> {
    /// Entries of the projection up to this size count as zero. A column with a smaller diagonal entry counts as determined.
    const COMPONENT_MIN: f64 = 0.1;
    let mut projection = DMatrix::<f64>::zeros(symmetric.nrows(), symmetric.ncols());
    let eigen = symmetric.symmetric_eigen();
    for (direction, value) in eigen.eigenvectors.column_iter().zip(eigen.eigenvalues.iter()) {
        if is_used(*value) {
            projection += direction * direction.transpose();
        }
    }
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for i in (0..projection.ncols()).filter(|i| projection[(*i, *i)] > COMPONENT_MIN) {
        let is_connected =
            |group: &Vec<usize>| group.iter().any(|j| projection[(i, *j)].abs() > COMPONENT_MIN);
        let (connected, others): (Vec<_>, Vec<_>) = groups.into_iter().partition(is_connected);
        groups = others;
        groups.push([connected.concat(), vec![i]].concat());
    }
    groups
}

/// Identifiability at `x` without a solve. Used for the selection of parameters and poses.
///
/// # Errors
/// [`SolveError`] if no sample has a value, a number is not finite, or the pass was cancelled.
pub fn identifiability(
    problem: &dyn LeastSquares,
    x: &[f64],
    options: &Options<'_>,
) -> Result<Identifiability, SolveError> {
    require_start(problem, x)?;
    let (triangle, fits) = sample_triangle(problem, x, options, Taking::WhatIsThere)
        .map_err(|error| error.at_start(problem.samples()))?;
    if !fits.iter().any(|fit| fit.present) {
        return Err(SolveError::NoSamples { samples: problem.samples() });
    }
    Ok(examine(problem, &triangle, &fits, options).0)
}

/// Identifiability and covariance at the end of a solve that took this number of iterations.
pub(in crate::solver) fn at_solution(
    problem: &dyn LeastSquares,
    x: &[f64],
    options: &Options<'_>,
    fits: &[SampleFit],
    iterations: usize,
) -> Result<(Identifiability, Covariance), SolveError> {
    let triangle = match sample_triangle(problem, x, options, Taking::These(fits)) {
        Ok((triangle, _)) => triangle,
        Err(PassError::Cancelled) => return Err(SolveError::Cancelled { iterations }),
        // The samples were finite at this point during the solve, so only squares of derivatives can have overflowed.
        Err(PassError::Lost | PassError::NotFinite(_)) => DMatrix::zeros(0, problem.columns()),
    };
    let (identifiability, spectrum) = examine(problem, &triangle, fits, options);
    let factor = options.noise.variance_factor(problem, x, fits);
    let covariance = Covariance::new(&spectrum, &identifiability.undetermined(), factor);
    Ok((identifiability, covariance))
}

/// Analyses the triangle of the samples' Jacobian. Returns the identifiability, and the spectrum of samples and priors
/// together for the covariance.
fn examine(
    problem: &dyn LeastSquares,
    triangle: &DMatrix<f64>,
    fits: &[SampleFit],
    options: &Options<'_>,
) -> (Identifiability, ScaledSpectrum) {
    let (columns, priors, tolerance) = (problem.columns(), problem.priors(), options.rank_tolerance);
    let open = Open::new(triangle, 0..columns, priors, tolerance);
    let mut spectrum = ScaledSpectrum::new(&with_priors(priors.iter(), triangle), tolerance);
    // A prior determines its column even if the singular value is below the tolerance.
    spectrum.rank = columns - open.missing();
    let mut prior_sigmas = vec![None; columns];
    priors.iter().for_each(|prior| prior_sigmas[prior.column] = Some(prior.sigma));
    let identifiability = Identifiability {
        prior_sigmas,
        names: (0..columns).map(|column| problem.column_name(column)).collect(),
        rank: spectrum.rank,
        rank_of_samples: if priors.is_empty() {
            spectrum.rank
        } else {
            rank(&scaled(triangle).0.singular_values(), tolerance)
        },
        singular_values: spectrum.singular_values.iter().copied().collect(),
        groups: open.groups(),
        zero_columns: open.zero_columns(),
        triangle: triangle.clone(),
        samples: fits.iter().filter(|fit| fit.present).count(),
    };
    (identifiability, spectrum)
}

/// Maximum number of iterations of a singular value decomposition per column. About two per column are needed.
const SVD_ITERATIONS_PER_COLUMN: usize = 100;

/// Singular values and right singular vectors of a triangle whose columns are scaled to unit length.
pub(in crate::solver) struct ScaledSpectrum {
    /// Column lengths before scaling; zero for a zero column.
    pub(in crate::solver) lengths: DVector<f64>,
    /// Singular values in descending order.
    pub(in crate::solver) singular_values: DVector<f64>,
    /// Right singular vectors, one row for each singular value.
    pub(in crate::solver) v_transposed: DMatrix<f64>,
    /// Number of singular values that count as nonzero.
    pub(in crate::solver) rank: usize,
}

impl ScaledSpectrum {
    fn new(triangle: &DMatrix<f64>, tolerance: f64) -> Self {
        let (scaled, lengths) = scaled(triangle);
        let columns = lengths.len();
        // The number of iterations is limited, because the iteration does not end for a matrix that is not finite.
        let svd = scaled.try_svd(false, true, 5.0 * f64::EPSILON, SVD_ITERATIONS_PER_COLUMN * columns);
        let (singular_values, v_transposed) = svd
            .and_then(|svd| Some((svd.singular_values, svd.v_t?)))
            .unwrap_or_else(|| (DVector::zeros(columns), DMatrix::identity(columns, columns)));
        let rank = rank(&singular_values, tolerance);
        Self { lengths, singular_values, v_transposed, rank }
    }

    /// Orthonormal basis of the null space, one column for each direction that is not determined.
    fn null_basis(&self) -> DMatrix<f64> {
        let missing = self.v_transposed.nrows() - self.rank;
        self.v_transposed.rows(self.rank, missing).transpose()
    }
}

/// Scales the columns of a triangle to unit length. Also returns the lengths before scaling, which are zero for a zero column.
fn scaled(triangle: &DMatrix<f64>) -> (DMatrix<f64>, DVector<f64>) {
    let columns = triangle.ncols();
    let mut lengths = DVector::from_iterator(columns, triangle.column_iter().map(|c| c.norm()));
    // A column that is negligible relative to the longest one is rounding noise and counts as zero.
    let longest = lengths.max();
    lengths.iter_mut().for_each(|l| {
        if *l <= 1e-12 * longest {
            *l = 0.0;
        }
    });
    // The matrix is at least square, so that every column has a right singular vector.
    let mut scaled = DMatrix::zeros(columns.max(triangle.nrows()), columns);
    scaled.rows_mut(0, triangle.nrows()).copy_from(triangle);
    for (mut column, &length) in scaled.column_iter_mut().zip(lengths.iter()) {
        column *= if length > 0.0 { length.recip() } else { 0.0 };
    }
    (scaled, lengths)
}

/// Number of singular values larger than `tolerance` times the largest one.
fn rank(singular_values: &DVector<f64>, tolerance: f64) -> usize {
    let floor = tolerance * singular_values.max();
    singular_values.iter().filter(|s| **s > floor).count()
}

/// Triangle of the samples' weighted Jacobian, and the fit of each sample.
pub(in crate::solver) fn sample_triangle(
    problem: &dyn LeastSquares,
    x: &[f64],
    options: &Options<'_>,
    taking: Taking<'_>,
) -> Result<(DMatrix<f64>, Vec<SampleFit>), PassError> {
    let pass = Pass::new(problem, x, options, taking);
    let (triangle, fits) = pass.run(|| Triangle::new(problem.columns()))?;
    let triangle = triangle.of_jacobian();
    // Squares of finite derivatives can overflow.
    if triangle.iter().all(|entry| entry.is_finite()) { Ok((triangle, fits)) } else { Err(PassError::Lost) }
}

/// Triangle of the rows of `triangle` and of one additional row for each prior, which is `1 / sigma` in the prior's column.
pub(in crate::solver) fn with_priors<'a>(
    priors: impl Iterator<Item = &'a Prior> + Clone,
    triangle: &DMatrix<f64>,
) -> DMatrix<f64> {
    let mut stacked = DMatrix::zeros(triangle.nrows() + priors.clone().count(), triangle.ncols());
    stacked.rows_mut(0, triangle.nrows()).copy_from(triangle);
    for (i, prior) in priors.enumerate() {
        stacked[(triangle.nrows() + i, prior.column)] = prior.sigma.recip();
    }
    stacked.qr().unpack_r()
}

/// Checks that the point has a value for each column.
pub(in crate::solver) fn require_start(problem: &dyn LeastSquares, x: &[f64]) -> Result<(), SolveError> {
    if x.len() == problem.columns() {
        return Ok(());
    }
    Err(SolveError::StartLength { found: x.len(), expected: problem.columns() })
}

/// Spectrum of the columns without prior (`J_f` in the module documentation), which only the samples can determine.
pub(in crate::solver) struct Open {
    /// Indices of the columns without prior.
    columns: Vec<usize>,
    /// `None` if every column has a prior.
    spectrum: Option<ScaledSpectrum>,
}

impl Open {
    /// Analyses the columns in `all` that have no prior.
    pub(in crate::solver) fn new(
        triangle: &DMatrix<f64>,
        all: impl Iterator<Item = usize>,
        priors: &[Prior],
        tolerance: f64,
    ) -> Self {
        let has_prior = |column: usize| priors.iter().any(|prior| prior.column == column);
        let columns: Vec<usize> = all.filter(|column| !has_prior(*column)).collect();
        let spectrum =
            (!columns.is_empty()).then(|| ScaledSpectrum::new(&triangle.select_columns(&columns), tolerance));
        Self { columns, spectrum }
    }

    /// Number of directions that the samples do not determine.
    pub(in crate::solver) fn missing(&self) -> usize {
        self.spectrum.as_ref().map_or(0, |spectrum| self.columns.len() - spectrum.rank)
    }

    fn zero_columns(&self) -> Vec<usize> {
        let Some(spectrum) = &self.spectrum else { return Vec::new() };
        let with_lengths = self.columns.iter().zip(spectrum.lengths.iter());
        with_lengths.filter(|(_, length)| **length == 0.0).map(|(column, _)| *column).collect()
    }

    fn groups(&self) -> Vec<DependentGroup> {
        let Some(spectrum) = &self.spectrum else { return Vec::new() };
        let zero: Vec<usize> =
            (0..self.columns.len()).filter(|place| spectrum.lengths[*place] == 0.0).collect();
        let mut groups = dependent_groups(&spectrum.null_basis(), &zero);
        for column in groups.iter_mut().flat_map(|group| &mut group.columns) {
            *column = self.columns[*column];
        }
        groups
    }
}
