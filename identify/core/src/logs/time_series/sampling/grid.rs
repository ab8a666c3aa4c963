//! Finds the grid to which stamps are rounded: the interval of which all stamps are whole multiples, up to an offset.

/// Tolerance for the decimal digits of stamps \[s\], because files contain stamps to microseconds or better.
pub(super) const WRITTEN_S: f64 = 1.5e-6;

/// The grid of the stamps \[s\]; `None` if there is none. All stamps are an offset plus whole multiples of the grid. The
/// offset changes only where the clock is set.
pub(super) fn find_grid(t_s: &[f64]) -> Option<f64> {
    /// Smallest grid that is searched for \[s\]. Finer grids come from the number of digits in the file.
    const GRID_S_MIN: f64 = 2e-4;
    /// Largest number of cells of the grid in the smallest distance between two stamps.
    const PARTS_MAX: u32 = 32;
    /// A grid is a multiple of this \[s\], or a whole fraction of a second. Stamps that are not rounded fit such a grid only
    /// if their clock has one of a few rates.
    const ROUND_S: f64 = 1e-5;
    /// Largest number of changes of the offset.
    const CHANGES_MAX: usize = 3;
    let steps_s = t_s.windows(2).map(|pair| pair[1] - pair[0]).filter(|step_s| *step_s > WRITTEN_S);
    let least_s = steps_s.fold(f64::INFINITY, f64::min);
    let is_grid = |grid_s: &f64| {
        let (mut offset_s, mut changes) = (t_s[0], 0);
        t_s.iter().all(|t_s| {
            let off_s = t_s - offset_s - ((t_s - offset_s) / grid_s).round() * grid_s;
            if off_s.abs() > WRITTEN_S {
                (offset_s, changes) = (*t_s, changes + 1);
            }
            changes <= CHANGES_MAX
        })
    };
    let parts_s = (1..=PARTS_MAX).map(|part| least_s / f64::from(part));
    let round_s = |part_s: f64| [(part_s / ROUND_S).round() * ROUND_S, 1.0 / (1.0 / part_s).round()];
    let rounded_s = parts_s.take_while(|part_s| *part_s > GRID_S_MIN).flat_map(round_s);
    rounded_s.filter(|grid_s| grid_s.is_finite()).find(is_grid)
}
