//! Thins the points of a figure to those that can be distinguished. Ten hours of data contain a million points, but a figure
//! has only a thousand columns of pixels.

use std::collections::HashSet;

use crate::inspect::curves::extremes_of_columns;

/// Position in a figure: x and y, in whole SVG units.
pub(in crate::report::page) type SvgPoint = (i32, i32);

/// Largest number of dots of one series.
const DOTS_MAX: usize = 4000;

/// Thins a line. From the points in one column, the first, the lowest, the highest and the last point are kept. `column` is
/// the width of a column in SVG units. The thinned line looks like the whole line.
pub(in crate::report::page) fn line(points: &[SvgPoint], column: i32) -> Vec<SvgPoint> {
    extremes_of_columns(points, |(x, _)| i64::from(x.div_euclid(column.max(1))), |(_, y)| f64::from(*y))
}

/// Thins dots. One dot is kept in each occupied cell of a grid. The size of the cells is doubled until at most [`DOTS_MAX`]
/// dots remain. A single dot far from all others is always kept.
pub(in crate::report::page) fn dots(points: Vec<SvgPoint>) -> Vec<SvgPoint> {
    let mut cell = 1;
    loop {
        let mut taken = HashSet::new();
        let of_cell = |(x, y): &SvgPoint| taken.insert((x.div_euclid(cell), y.div_euclid(cell)));
        let mut kept = points.clone();
        kept.retain(of_cell);
        if kept.len() <= DOTS_MAX {
            return kept;
        }
        cell *= 2;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::rngs::StdRng;
    use rand::{Rng, SeedableRng};

    fn cloud(count: usize) -> Vec<SvgPoint> {
        let mut random = StdRng::seed_from_u64(1);
        (0..count).map(|i| ((i * 2700 / count) as i32, random.random_range(300..600))).collect()
    }

    #[test]
    fn a_thinned_line_has_the_heights_of_the_whole_line_in_every_column() {
        let whole = cloud(200_000);
        let thinned = line(&whole, 3);
        assert!(thinned.len() <= 4 * 900, "{}", thinned.len());
        let heights = |points: &[SvgPoint], column: i32| {
            let within = points.iter().filter(|(x, _)| x / 3 == column).map(|(_, y)| *y);
            (within.clone().min(), within.max())
        };
        for column in 0..900 {
            assert_eq!(heights(&thinned, column), heights(&whole, column));
        }
        assert_eq!((thinned.first(), thinned.last()), (whole.first(), whole.last()));
    }

    #[test]
    fn few_points_stay_as_they_are() {
        let few = cloud(500);
        assert_eq!(line(&few, 3), few);
        assert_eq!(dots(few.clone()).len(), few.iter().collect::<HashSet<_>>().len());
    }

    #[test]
    fn a_dot_that_stands_alone_survives_a_million_others() {
        let mut many = cloud(1_000_000);
        many.insert(500_000, (1350, 20));
        let thinned = dots(many);
        assert!(thinned.len() <= DOTS_MAX);
        assert!(thinned.contains(&(1350, 20)));
    }
}
