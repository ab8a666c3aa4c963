//! Standard links and Hayati's describe the same robot.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use identify::kinematics::{Chain, ConversionError, robot_chain};
use proptest::prelude::*;

fn nominal(which: usize) -> Chain {
    let robots = [crate::support::irb2400(), crate::support::nj220()];
    robot_chain(&robots[which], &crate::support::bar())
}

fn apart(a: &Chain, b: &Chain, joints: &[f64; 6]) -> f64 {
    (a.forward(joints).to_homogeneous() - b.forward(joints).to_homogeneous()).amax()
}

proptest! {
    /// Errors of some milliradians on every link, as a calibration finds them: axes 2 and 3 are then nearly parallel, and
    /// the standard `d` of link 2 may be hundreds of metres.
    #[test]
    fn there_and_back_gives_the_same_poses_and_the_same_links(
        which in 0..2usize,
        link in prop::sample::select(vec![1usize]),
        errors in prop::collection::vec(-5e-3..5e-3f64, 24),
        d_m in -0.2..0.2f64,
        joints in prop::array::uniform6(-3.0..3.0f64),
    ) {
        let mut chain = nominal(which);
        for (link, e) in chain.links.iter_mut().zip(errors.chunks_exact(4)) {
            link.a_m += e[0];
            link.alpha_rad += e[1];
            link.d_m += e[2];
            link.theta_rad += e[3];
        }
        prop_assume!(chain.links[link].alpha_rad.abs() > 1e-5);
        let hayati = chain.with_hayati(link, d_m).unwrap();
        prop_assert_eq!(hayati.links[link].d_m, d_m);
        prop_assert!(hayati.links[link].beta_rad.abs() < 0.1);
        prop_assert!(apart(&chain, &hayati, &joints) < 1e-9, "{}", apart(&chain, &hayati, &joints));
        let back = hayati.with_standard(link).unwrap();
        prop_assert_eq!(back.links[link].beta_rad, 0.0);
        // A nearly parallel axis magnifies rounding: by the inverse of the angle between the axes.
        let limit = 1e-13 / chain.links[link].alpha_rad.abs().powi(2) + 1e-10;
        prop_assert!(apart(&chain, &back, &joints) < limit);
        prop_assert!((back.links[link].a_m - chain.links[link].a_m).abs() < limit);
        prop_assert!((back.links[link].d_m - chain.links[link].d_m).abs() < limit);
        prop_assert!((back.links[link].theta_rad - chain.links[link].theta_rad).sin().abs() < limit);
    }

    /// A link of Hayati's with its own errors, for which the standard form is large but exact.
    #[test]
    fn a_hayati_link_becomes_a_standard_one_however_far_its_common_normal_lies(
        alpha in 1e-4..2e-2f64, beta in 1e-4..2e-2f64, joints in prop::array::uniform6(-3.0..3.0f64),
    ) {
        let mut chain = nominal(0);
        chain.links[1].alpha_rad = alpha;
        chain.links[1].beta_rad = beta;
        let standard = chain.with_standard(1).unwrap();
        // The common normal lies at length over angle: metres to kilometres away.
        prop_assert!(apart(&chain, &standard, &joints) < 1e-12 / alpha.min(beta));
    }
}

#[test]
fn links_that_only_one_form_describes_are_errors() {
    let chain = nominal(0);
    assert_eq!(chain.with_standard(1).unwrap_err(), ConversionError::Parallel { link: 2 });
    assert_eq!(chain.with_hayati(5, 0.0).unwrap_err(), ConversionError::LastLink { link: 6 });
    assert_eq!(chain.with_standard(9).unwrap_err(), ConversionError::LastLink { link: 10 });
    let mut square = chain.clone();
    square.links[2].alpha_rad = std::f64::consts::FRAC_PI_2;
    // cos(pi/2) is not zero in binary, but nothing that could be measured.
    assert_eq!(square.with_hayati(2, 0.0).unwrap_err(), ConversionError::Perpendicular { link: 3 });
    let same = chain.with_hayati(1, chain.links[1].d_m).unwrap();
    assert!(apart(&chain, &same, &[0.3; 6]) < 1e-15);
}
