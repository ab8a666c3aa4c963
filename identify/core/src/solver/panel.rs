//! A panel collects the residuals and Jacobians of several samples in a short block of rows. A `pass` reduces each full
//! panel to a normal matrix or a triangle. The Jacobian of all samples is therefore never stored.

use nalgebra::DMatrix;

use super::kernel::{self, COLUMN_STEP, ROW_STEP, Shape};

/// Number of rows of a panel, except if a single sample has more. A panel with this many rows and 40 columns fits
/// into the second-level cache.
const PANEL_ROWS: usize = 240;

/// Jacobian of one sample: an entry for each row of the sample, in each column of a panel.
#[derive(Debug)]
pub struct Block<'a> {
    /// Jacobian of the panel that contains the sample, column-major.
    data: &'a mut [f64],
    /// Distance between the starts of two columns.
    stride: usize,
    /// First row of the sample.
    offset: usize,
    rows: usize,
}

impl Block<'_> {
    /// Derivatives of all rows of the sample with respect to one parameter. Empty if the column does not exist.
    #[inline]
    pub fn column_mut(&mut self, column: usize) -> &mut [f64] {
        let start = column * self.stride + self.offset;
        self.data.get_mut(start..start + self.rows).unwrap_or_default()
    }

    /// Multiplies all derivatives by a factor, such as a weight or a change of unit.
    pub fn scale(&mut self, factor: f64) {
        self.for_each(|value| *value *= factor);
    }

    pub(super) fn clear(&mut self) {
        self.for_each(|value| *value = 0.0);
    }

    #[inline]
    fn for_each(&mut self, change: impl Fn(&mut f64)) {
        for column in self.data.chunks_exact_mut(self.stride) {
            column[self.offset..self.offset + self.rows].iter_mut().for_each(&change);
        }
    }
}

/// Weighted rows of several samples, column-major. The columns are:
///
/// ```text
/// 0 .. columns-1         columns     columns+1 .. width-1
/// Jacobian               residual    zeros
/// ```
///
/// The zero columns make `width` a multiple of the kernel's column step.
pub(super) struct RowPanel {
    data: Vec<f64>,
    stride: usize,
    /// Number of columns of the Jacobian.
    columns: usize,
    /// Number of all columns, see [`width`].
    width: usize,
    /// Highest number of rows. The next field, `used`, is the number of rows in use.
    capacity: usize,
    used: usize,
    /// For each sample, its index and the row after its last row.
    samples: Vec<(usize, usize)>,
}

impl RowPanel {
    /// Creates an empty panel for samples of `rows` rows. Samples that represent prior knowledge may have more rows,
    /// but at most [`PANEL_ROWS`].
    pub(super) fn new(columns: usize, rows: usize) -> Self {
        let capacity = PANEL_ROWS.max(rows);
        let (stride, width) = (capacity.next_multiple_of(ROW_STEP), width(columns));
        let data = vec![0.0; stride * width];
        Self { data, stride, columns, width, capacity, used: 0, samples: Vec::new() }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    pub(super) fn has_room(&self, rows: usize) -> bool {
        self.used + rows <= self.capacity
    }

    pub(super) fn clear(&mut self) {
        self.data.fill(0.0);
        self.samples.clear();
        self.used = 0;
    }

    /// Residual and Jacobian of the next sample, to be filled in by the caller. They refer to the next `rows` unused rows,
    /// which are zero. The rows count as unused until [`RowPanel::keep`] is called.
    pub(super) fn next(&mut self, rows: usize) -> (&mut [f64], Block<'_>) {
        let offset = self.used;
        let (jacobian, rest) = self.data.split_at_mut(self.columns * self.stride);
        let residual = &mut rest[offset..offset + rows];
        (residual, Block { data: jacobian, stride: self.stride, offset, rows })
    }

    /// Marks the rows from [`RowPanel::next`] as rows in use that belong to this sample.
    pub(super) fn keep(&mut self, sample: usize, rows: usize) {
        self.used += rows;
        self.samples.push((sample, self.used));
    }

    /// Shape of the rows in use, padded to a multiple of the row step. Its columns are Jacobian and residual,
    /// without the zero columns.
    fn shape(&self) -> Shape {
        let rows = self.used.next_multiple_of(ROW_STEP);
        Shape { stride: self.stride, rows, columns: self.columns + 1 }
    }

    /// Index of the first sample with a number that is not finite.
    pub(super) fn not_finite(&self) -> Option<usize> {
        if kernel::is_finite(&self.data, self.shape()) {
            return None;
        }
        let is_finite = |row: usize| (0..=self.columns).all(|c| self.data[c * self.stride + row].is_finite());
        let row = (0..self.used).find(|&row| !is_finite(row))?;
        self.samples.iter().find(|(_, end)| row < *end).map(|(sample, _)| *sample)
    }

    /// Adds the dot products of all pairs of columns to `sums`, a square matrix with [`width`] columns.
    pub(super) fn add_products(&self, sums: &mut [f64]) {
        kernel::add_products(&self.data, Shape { columns: self.width, ..self.shape() }, sums);
    }

    /// Reduces Jacobian and residual together with `triangle`, which has `columns + 1` columns, to a new
    /// triangle. Overwrites the panel.
    pub(super) fn fold_into_triangle(&mut self, triangle: &mut [f64]) {
        let shape = self.shape();
        kernel::fold_into_triangle(&mut self.data, shape, triangle);
    }

    /// Appends the residual entries to `residual` and the Jacobian to `gradients`, row by row.
    pub(super) fn append_to(&self, residual: &mut Vec<f64>, gradients: &mut Vec<f64>) {
        for row in 0..self.used {
            residual.push(self.data[self.columns * self.stride + row]);
            gradients.extend((0..self.columns).map(|c| self.data[c * self.stride + row]));
        }
    }
}

/// Number of columns of a panel: Jacobian, residual and zero columns.
pub(super) fn width(columns: usize) -> usize {
    (columns + 1).next_multiple_of(COLUMN_STEP)
}

/// Replaces `into` by the triangular factor of the stacked matrix `[into; from]`. Both are upper triangles of
/// the same size, column-major.
pub(super) fn fold_triangles(from: &DMatrix<f64>, into: &mut DMatrix<f64>) {
    let columns = into.ncols();
    let stride = columns.next_multiple_of(ROW_STEP);
    let mut panel = vec![0.0; stride * columns];
    for (to, from) in panel.chunks_exact_mut(stride.max(1)).zip(from.column_iter()) {
        to[..columns].copy_from_slice(from.as_slice());
    }
    kernel::fold_into_triangle(&mut panel, Shape { stride, rows: stride, columns }, into.as_mut_slice());
}
