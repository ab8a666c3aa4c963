//! Samples gathered into a short panel of rows, then folded into a normal matrix or a triangle.

use nalgebra::{DMatrix, DMatrixView, DVector, Dyn};

use super::{Loss, Problem};

/// Rows gathered before they are folded: a panel of 40 columns stays in the second-level cache.
const PANEL_ROWS: usize = 240;

/// Jacobian of one sample: `rows` entries for each column.
#[derive(Debug)]
pub struct Block<'a> {
    data: &'a mut [f64],
    stride: usize,
    offset: usize,
    rows: usize,
}

impl Block<'_> {
    /// The derivatives of all rows by one column; empty for a column that does not exist.
    #[inline]
    pub fn column_mut(&mut self, column: usize) -> &mut [f64] {
        let start = column * self.stride + self.offset;
        self.data.get_mut(start..start + self.rows).unwrap_or_default()
    }

    /// Multiplies all derivatives: a weight or a unit.
    pub fn scale(&mut self, factor: f64) {
        for column in self.data.chunks_exact_mut(self.stride) {
            for value in &mut column[self.offset..self.offset + self.rows] {
                *value *= factor;
            }
        }
    }

    fn is_finite(&self) -> bool {
        let mut sum = 0.0;
        for column in self.data.chunks_exact(self.stride) {
            sum += column[self.offset..self.offset + self.rows].iter().sum::<f64>();
        }
        sum.is_finite()
    }
}

/// Weighted rows of several samples: Jacobian (column-major) and residual.
pub(super) struct Panel {
    jacobian: Vec<f64>,
    residual: DVector<f64>,
    stride: usize,
    columns: usize,
    used: usize,
}

impl Panel {
    fn new(columns: usize, rows_per_sample: usize) -> Self {
        let stride = PANEL_ROWS.max(rows_per_sample);
        Self {
            jacobian: vec![0.0; stride * columns],
            residual: DVector::zeros(stride),
            stride,
            columns,
            used: 0,
        }
    }

    fn clear(&mut self) {
        self.jacobian.fill(0.0);
        self.residual.fill(0.0);
        self.used = 0;
    }

    /// Jacobian of the rows in use.
    pub(super) fn jacobian(&self) -> DMatrixView<'_, f64, nalgebra::U1, Dyn> {
        DMatrixView::from_slice_with_strides_generic(
            &self.jacobian,
            Dyn(self.used),
            Dyn(self.columns),
            nalgebra::U1,
            Dyn(self.stride),
        )
    }

    /// The same, transposed without a copy.
    pub(super) fn jacobian_transposed(&self) -> DMatrixView<'_, f64, Dyn, nalgebra::U1> {
        DMatrixView::from_slice_with_strides_generic(
            &self.jacobian,
            Dyn(self.columns),
            Dyn(self.used),
            Dyn(self.stride),
            nalgebra::U1,
        )
    }

    /// Residual of the rows in use.
    pub(super) fn residual(&self) -> nalgebra::DVectorView<'_, f64> {
        self.residual.rows(0, self.used)
    }
}

/// What one sample is worth in a pass.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct SampleFit {
    /// The sample has a value here.
    pub(super) present: bool,
    /// Squared norm of its residual, unweighted.
    pub(super) squared: f64,
    /// Weight of the robust loss.
    pub(super) weight: f64,
}

/// Why a pass over the samples was given up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PassError {
    /// A sample that takes part has no value here.
    Lost,
    /// A residual or derivative of this sample is not finite.
    NotFinite(usize),
}

/// Which samples take part.
#[derive(Debug, Clone, Copy)]
pub(super) enum Taking<'a> {
    /// All that have a value: the first pass, which decides.
    WhatIsThere,
    /// Exactly these.
    These(&'a [SampleFit]),
}

/// Goes over all samples at `x`, hands full panels of weighted rows to `fold`, and returns each sample's fit.
pub(super) fn pass<P: Problem>(
    problem: &P,
    x: &[f64],
    loss: Loss,
    taking: Taking<'_>,
    mut fold: impl FnMut(&Panel),
) -> Result<Vec<SampleFit>, PassError> {
    let rows = problem.rows();
    let mut point = problem.point(x);
    let mut panel = Panel::new(problem.columns(), rows);
    let mut fits = vec![SampleFit::default(); problem.samples()];
    for (sample, fit) in fits.iter_mut().enumerate() {
        if let Taking::These(these) = taking
            && !these.get(sample).is_some_and(|fit| fit.present)
        {
            continue;
        }
        if panel.used + rows > panel.stride {
            fold(&panel);
            panel.clear();
        }
        let offset = panel.used;
        let residual = &mut panel.residual.as_mut_slice()[offset..offset + rows];
        let mut block = Block { data: &mut panel.jacobian, stride: panel.stride, offset, rows };
        if !problem.sample(&mut point, sample, residual, &mut block) {
            match taking {
                Taking::WhatIsThere => {
                    residual.fill(0.0);
                    block.scale(0.0);
                    continue;
                }
                Taking::These(_) => return Err(PassError::Lost),
            }
        }
        let squared: f64 = residual.iter().map(|r| r * r).sum();
        if !squared.is_finite() || !block.is_finite() {
            return Err(PassError::NotFinite(sample));
        }
        let weight = loss.weight(squared);
        if weight != 1.0 {
            let factor = weight.sqrt();
            residual.iter_mut().for_each(|r| *r *= factor);
            block.scale(factor);
        }
        *fit = SampleFit { present: true, squared, weight };
        panel.used += rows;
    }
    if panel.used > 0 {
        fold(&panel);
    }
    Ok(fits)
}

/// `H += J^T J` (the lower triangle, and some of the upper), `g += J^T r`.
pub(super) fn fold_normal(panel: &Panel, normal: &mut DMatrix<f64>, gradient: &mut DVector<f64>) {
    let jacobian = panel.jacobian();
    gradient.gemv_tr(1.0, &jacobian, &panel.residual(), 1.0);
    let mut first = 0;
    while first < panel.columns {
        let width = COLUMNS_TOGETHER.min(panel.columns - first);
        let below = panel.columns - first;
        let mut target = normal.view_mut((first, first), (below, width));
        // nalgebra hands larger products to a blocked, vectorised kernel that takes any strides; its own loops below
        // that size want contiguous columns.
        if width.min(panel.used) > BLOCKED_KERNEL_ABOVE {
            let left = panel.jacobian_transposed();
            target.gemm(1.0, &left.rows(first, below), &jacobian.columns(first, width), 1.0);
        } else {
            target.gemm_tr(1.0, &jacobian.columns(first, below), &jacobian.columns(first, width), 1.0);
        }
        first += width;
    }
}

/// Columns of the normal matrix that are formed at once, from the diagonal down.
const COLUMNS_TOGETHER: usize = 16;

/// nalgebra's own limit.
const BLOCKED_KERNEL_ABOVE: usize = 5;

/// `R <- triangle of [R; J]` by Householder QR, so that `R^T R` grows by `J^T J` without being formed.
pub(super) fn fold_triangle(jacobian: &DMatrixView<'_, f64, nalgebra::U1, Dyn>, triangle: &mut DMatrix<f64>) {
    let (kept, columns) = triangle.shape();
    let mut stacked = DMatrix::zeros(kept + jacobian.nrows(), columns);
    stacked.rows_mut(0, kept).copy_from(triangle);
    stacked.rows_mut(kept, jacobian.nrows()).copy_from(jacobian);
    *triangle = stacked.qr().unpack_r();
}

/// Squared residual norm of each sample that has a value at `x`, without loss. Empty where one is not finite.
pub fn squared_norms<P: Problem>(problem: &P, x: &[f64]) -> Vec<f64> {
    let fits = pass(problem, x, Loss::Squared, Taking::WhatIsThere, |_| ()).unwrap_or_default();
    fits.iter().filter(|fit| fit.present).map(|fit| fit.squared).collect()
}

/// Residuals and Jacobian of all samples that have a value at `x`, stacked, without loss and priors: for looking at,
/// and for other solvers. None where one of them is not finite.
pub fn stacked<P: Problem>(problem: &P, x: &[f64]) -> Option<(DVector<f64>, DMatrix<f64>)> {
    let mut residual = Vec::new();
    let mut gradients = Vec::new();
    pass(problem, x, Loss::Squared, Taking::WhatIsThere, |panel| {
        residual.extend(panel.residual().iter().copied());
        gradients.extend(panel.jacobian_transposed().iter().copied());
    })
    .ok()?;
    let rows = residual.len();
    Some((DVector::from_vec(residual), DMatrix::from_row_slice(rows, problem.columns(), &gradients)))
}
