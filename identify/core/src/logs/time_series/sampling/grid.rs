//! The grid to which stamps are rounded.

/// Stamps are written to microseconds or better \[s\].
pub(super) const WRITTEN_S: f64 = 1.5e-6;

/// The grid of the stamps \[s\]: all are whole multiples of it plus an offset, which changes only where the clock is set.
pub(super) fn find_grid(t_s: &[f64]) -> Option<f64> {
    /// Finer grids come from the format \[s\].
    const GRID_S_MIN: f64 = 2e-4;
    /// Largest number of cells in the smallest distance of stamps.
    const PARTS_MAX: u32 = 32;
    /// Grids are multiples of this \[s\], or whole parts of a second: a clock that is even is on no grid, but for a rare rate.
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
