//! An independent implementation of the kinematics with 4 x 4 matrices over any scalar type. It shares no
//! code with the library. With dual numbers it differentiates automatically, so that analytic Jacobians can
//! be compared with its derivatives.

use num_dual::DualNum;

pub type Matrix<D> = [[D; 4]; 4];

/// Parameters a, alpha, d, theta and beta of one link.
pub type Link<D> = [D; 5];

pub fn identity<D: DualNum<f64> + Copy>() -> Matrix<D> {
    std::array::from_fn(|i| std::array::from_fn(|j| D::from(if i == j { 1.0 } else { 0.0 })))
}

pub fn product<D: DualNum<f64> + Copy>(a: &Matrix<D>, b: &Matrix<D>) -> Matrix<D> {
    std::array::from_fn(|i| {
        std::array::from_fn(|j| a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j] + a[i][3] * b[3][j])
    })
}

pub fn shift<D: DualNum<f64> + Copy>(x: D, y: D, z: D) -> Matrix<D> {
    let mut m = identity();
    (m[0][3], m[1][3], m[2][3]) = (x, y, z);
    m
}

/// A rotation in the plane of axes `i` and `j`: (0, 1) is about z, (1, 2) about x, (2, 0) about y.
pub fn turn<D: DualNum<f64> + Copy>(i: usize, j: usize, angle: D) -> Matrix<D> {
    let (s, c) = (angle.sin(), angle.cos());
    let mut m = identity();
    m[i][i] = c;
    m[j][j] = c;
    m[i][j] = -s;
    m[j][i] = s;
    m
}

pub fn forward<D: DualNum<f64> + Copy>(base: &Matrix<D>, links: &[Link<D>], joints: &[D]) -> Matrix<D> {
    let zero = D::from(0.0);
    links.iter().zip(joints).fold(*base, |pose, (&[a, alpha, d, theta, beta], &joint)| {
        let factors = [
            turn(0, 1, theta + joint),
            shift(zero, zero, d),
            shift(a, zero, zero),
            turn(1, 2, alpha),
            turn(2, 0, beta),
        ];
        factors.iter().fold(pose, |pose, factor| product(&pose, factor))
    })
}
