//! An independent implementation of the closed chain over any scalar type. It has all parameters, a motion as an analytic
//! function of time, and joint errors that are computed from their definition.

use identify::kinematics::{Chain, DhLink, LinkParameter, Pose};
use identify::model::{
    BACKLASH_SPEED_RAD_S, BasePlacement, DriveTrain, Geometry, JointState, JointTerm, Model, Observation,
    ParameterId, Period, Phase, RobotMotion,
};
use num_dual::{Dual64, DualNum};

use crate::support::Cell;
use crate::support::independent::{Link, Matrix, forward, identity, product, shift, turn};

/// A smooth motion whose joints are analytic functions of time.
#[derive(Debug)]
pub struct Sines;

pub fn sines<D: DualNum<f64> + Copy>(tau: D) -> [D; 6] {
    std::array::from_fn(|i| {
        let i = i as f64;
        (tau * (0.3 + 0.17 * i) + i).sin() * (0.9 - 0.05 * i) + 0.1 * i
    })
}

pub fn sines_rates<D: DualNum<f64> + Copy>(tau: D) -> [D; 6] {
    std::array::from_fn(|i| {
        let i = i as f64;
        (tau * (0.3 + 0.17 * i) + i).cos() * ((0.9 - 0.05 * i) * (0.3 + 0.17 * i))
    })
}

impl RobotMotion for Sines {
    fn at(&self, tau_s: f64) -> Option<JointState> {
        let moved = sines(Dual64::new(tau_s, 1.0));
        let rates = sines_rates(Dual64::new(tau_s, 1.0));
        Some(JointState {
            q: moved.map(|q| q.re).into(),
            qd: moved.map(|q| q.eps).into(),
            qdd: rates.map(|qd| qd.eps).into(),
        })
    }
}

/// Values of all parameters of the closed chain, in any scalar type. The order is that of the
/// [`ParameterId`]s from which they were created.
#[derive(Clone)]
pub struct Numbers<D> {
    pub robot: Vec<Link<D>>,
    pub bar: Vec<Link<D>>,
    pub origin: [D; 3],
    pub tilt: [D; 2],
    /// Compliance and play of the bar.
    pub elongation: [D; 2],
    /// Harmonics of the bar length. Indices: joint, order two or three per turn, sine or cosine.
    pub bar_waves: [[[D; 2]; 2]; 2],
    pub encoder_waves: [[[D; 2]; 2]; 5],
    /// Angles that are added to those of the encoders in origin 1.
    pub zeros: [D; 5],
    pub joint_errors: [[D; 18]; 6],
    /// Joint harmonics. Indices: joint, order three or four per turn, sine or cosine.
    pub joint_waves: [[[D; 2]; 2]; 6],
    /// Links of the nominal robot. The lever arms of weights are computed from these links.
    pub arm: Vec<DhLink>,
    pub clock: [D; 2],
    pub attachment: [D; 3],
    pub anchor: [D; 3],
    pub offset: D,
    pub scale: D,
}

pub fn encoder_waves(g: &Geometry) -> [[[f64; 2]; 2]; 5] {
    let mut g = g.clone();
    let mut amplitude =
        |joint, order, phase| *g.parameter_mut(ParameterId::EncoderWave { joint, order, phase }).unwrap();
    std::array::from_fn(|joint| [1, 2].map(|order| Phase::ALL.map(|phase| amplitude(joint, order, phase))))
}

pub fn bar_waves(g: &Geometry) -> [[[f64; 2]; 2]; 2] {
    let mut g = g.clone();
    let mut amplitude =
        |joint, order, phase| *g.parameter_mut(ParameterId::BarWave { joint, order, phase }).unwrap();
    [0, 1].map(|joint| [2, 3].map(|order| Phase::ALL.map(|phase| amplitude(joint, order, phase))))
}

pub fn place(term: JointTerm) -> usize {
    JointTerm::ALL.iter().position(|one| *one == term).unwrap()
}

pub fn joint_errors(g: &Geometry) -> [[f64; 18]; 6] {
    let mut g = g.clone();
    let mut amplitude =
        |axis, term| g.parameter_mut(ParameterId::Joint { axis, term }).map_or(0.0, |amplitude| *amplitude);
    std::array::from_fn(|axis| JointTerm::ALL.map(|term| amplitude(axis, term)))
}

pub fn joint_waves(g: &Geometry) -> [[[f64; 2]; 2]; 6] {
    let mut g = g.clone();
    let mut amplitude =
        |axis, order, phase| *g.parameter_mut(ParameterId::JointWave { axis, order, phase }).unwrap();
    std::array::from_fn(|axis| [3, 4].map(|order| Phase::ALL.map(|phase| amplitude(axis, order, phase))))
}

/// A robot with coupled drives: drive 2 also turns joint 3 backwards, and drive 4 also turns joints 5 and 6. Numbers of
/// lobes and gear ratios are arbitrary. The robot is mounted at an angle.
pub fn coupled_drives(arm: &Chain) -> DriveTrain {
    let mut drives = DriveTrain::direct(arm);
    let couplings = [(1, 2, -1.0), (3, 4, 0.1), (3, 5, 0.05), (4, 5, 0.4)];
    for (drive, joint, part) in couplings {
        drives.joint_from_drive[drive][joint] = part;
    }
    let matrix = nalgebra::Matrix6::from_fn(|i, j| drives.joint_from_drive[i][j]);
    let inverse = matrix.try_inverse().unwrap();
    drives.drive_from_joint = inverse.row_iter().map(|row| row.iter().copied().collect()).collect();
    drives.cycloid_lobes = [7.0, 11.0, 9.0, 5.0, 6.0, 4.0].map(Some).to_vec();
    drives.motor_turns = [3.5, 6.1, 4.2, 3.3, 5.7, 2.9].map(Some).to_vec();
    drives.gravity = nalgebra::Vector3::new(0.36, -0.48, -0.8);
    drives
}

pub fn coupled(cell: &Cell) -> Model {
    let waves = ParameterId::joint_waves(4);
    cell.model()
        .with_drives(coupled_drives(&cell.robot))
        .with(waves)
        .with(ParameterId::all().filter(|id| matches!(id, ParameterId::EncoderOffset { origin: 1, .. })))
}

/// Joint angles with all errors of [`coupled_drives`], computed from the definition of the errors: basis functions of the
/// reported angles of the drives. `fine` contains the harmonics of orders three and four per turn.
pub fn true_joints<D: DualNum<f64> + Copy>(
    arm: &[DhLink],
    errors: &[[D; 18]; 6],
    fine: &[[[D; 2]; 2]; 6],
    tau: D,
) -> [D; 6] {
    let arm: Vec<Link<D>> = links(arm);
    let (q, qd) = (sines(tau), sines_rates(tau));
    // Solves joints = drives C explicitly for the drives.
    let drives = |q: [D; 6]| {
        let [q1, q2, q3, q4, q5, q6] = q;
        let d5 = q5 - q4 * 0.1;
        [q1, q2, q3 + q2, q4, d5, q6 - q4 * 0.05 - d5 * 0.4]
    };
    let (g, rate) = (drives(q), drives(qd));
    let frame = |links: usize| forward(&identity(), &arm[..links], &q);
    let lever = |axis: usize, at: usize| {
        let (base, load) = (frame(axis), frame(at));
        let gravity = [0.36, -0.48, -0.8];
        let r: [D; 3] = std::array::from_fn(|i| load[i][3] - base[i][3]);
        let cross = |i: usize, j: usize| r[i] * gravity[j] - r[j] * gravity[i];
        base[0][2] * cross(1, 2) + base[1][2] * cross(2, 0) + base[2][2] * cross(0, 1)
    };
    let error: [D; 6] = std::array::from_fn(|i| {
        let lobes = [7.0, 11.0, 9.0, 5.0, 6.0, 4.0][i];
        let turns = [3.5, 6.1, 4.2, 3.3, 5.7, 2.9][i];
        let waves = [1.0, 2.0, lobes, turns].map(|n| [(g[i] * n).sin(), (g[i] * n).cos()]);
        let shapes = waves.into_iter().flatten().chain([D::from(0.0); 4]).chain([
            (rate[i] / BACKLASH_SPEED_RAD_S).tanh(),
            g[i],
            D::from(0.0),
        ]);
        // The delay has no basis function, because it uses the angle at another instant.
        let delay = |i: usize| errors[i][place(JointTerm::Delay)];
        let mean = (0..6).map(delay).fold(D::from(0.0), |a, b| a + b) / 6.0;
        let later = drives(sines(tau + delay(i) - mean))[i] - g[i];
        let levers = [2, 4, 6].map(|at| lever(i, at));
        let more = [3.0, 4.0].map(|n| [(g[i] * n).sin(), (g[i] * n).cos()]).into_iter().flatten();
        let more = more.zip(fine[i].into_iter().flatten());
        shapes
            .chain(levers)
            .zip(errors[i])
            .chain(more)
            .map(|(shape, amplitude)| shape * amplitude)
            .fold(later, |a, b| a + b)
    });
    let [e1, e2, e3, e4, e5, e6] = error;
    let moved = [e1, e2, e3 - e2, e4, e5 + e4 * 0.1, e6 + e4 * 0.05 + e5 * 0.4];
    std::array::from_fn(|i| {
        // Harmonics of the joint itself, which are added to those of its drive.
        let own = [(1.0, Period::JointOnce), (2.0, Period::JointTwice)].map(|(n, period)| {
            let [sine, cosine] = Phase::ALL.map(|phase| errors[i][place(JointTerm::Wave(period, phase))]);
            sine * (q[i] * n).sin() + cosine * (q[i] * n).cos()
        });
        q[i] + moved[i] + own[0] + own[1]
    })
}

pub fn links<D: DualNum<f64> + Copy>(links: &[identify::kinematics::DhLink]) -> Vec<Link<D>> {
    links.iter().map(|l| [l.a_m, l.alpha_rad, l.d_m, l.theta_rad, l.beta_rad].map(D::from)).collect()
}

impl<D: DualNum<f64> + Copy> Numbers<D> {
    pub fn new(arm: &Chain, g: &Geometry) -> Self {
        Self {
            arm: arm.links.clone(),
            robot: links(&g.robot.links),
            bar: links(&g.bar_links),
            origin: [0, 1, 2].map(|i| D::from(g.base.origin_m[i])),
            tilt: [g.base.rx_rad, g.base.ry_rad].map(D::from),
            elongation: [g.elongation.compliance_m_per_n, g.elongation.play_m].map(D::from),
            bar_waves: bar_waves(g).map(|joint| joint.map(|order| order.map(D::from))),
            encoder_waves: encoder_waves(g).map(|joint| joint.map(|order| order.map(D::from))),
            zeros: g.offsets_of_origin(1).map(D::from),
            joint_errors: joint_errors(g).map(|axis| axis.map(D::from)),
            joint_waves: joint_waves(g).map(|axis| axis.map(|order| order.map(D::from))),
            clock: [g.clock.shift_s, g.clock.skew].map(D::from),
            attachment: [0, 1, 2].map(|i| D::from(g.wire.attachments_m.first().map_or(0.0, |at| at[i]))),
            anchor: [0, 1, 2].map(|i| D::from(g.wire.anchors_m.first().map_or(0.0, |at| at[i]))),
            offset: D::from(g.wire.offset_m),
            scale: D::from(g.scale),
        }
    }

    pub fn number(&mut self, id: ParameterId) -> &mut D {
        let at = |parameter| match parameter {
            LinkParameter::A => 0,
            LinkParameter::Alpha => 1,
            LinkParameter::D => 2,
            LinkParameter::Theta => 3,
            LinkParameter::Beta => 4,
        };
        match id {
            ParameterId::Robot { link, parameter } => &mut self.robot[link][at(parameter)],
            ParameterId::Bar { link, parameter } => &mut self.bar[link][at(parameter)],
            ParameterId::Base { axis } => &mut self.origin[axis.index()],
            ParameterId::BaseRotation { axis } => &mut self.tilt[axis.index()],
            ParameterId::BarCompliance => &mut self.elongation[0],
            ParameterId::BarPlay => &mut self.elongation[1],
            ParameterId::BarWave { joint, order, phase } => {
                &mut self.bar_waves[joint][usize::from(order) - 2][phase as usize]
            }
            ParameterId::EncoderWave { joint, order, phase } => {
                &mut self.encoder_waves[joint][usize::from(order) - 1][phase as usize]
            }
            ParameterId::EncoderOffset { joint, .. } => &mut self.zeros[joint],
            ParameterId::Joint { axis, term } => &mut self.joint_errors[axis][place(term)],
            ParameterId::JointWave { axis, order, phase } => {
                &mut self.joint_waves[axis][usize::from(order) - 3][phase as usize]
            }
            ParameterId::ClockShift => &mut self.clock[0],
            ParameterId::ClockSkew => &mut self.clock[1],
            ParameterId::Attachment { target: 0, axis } => &mut self.attachment[axis.index()],
            ParameterId::Anchor { station: 0, axis } => &mut self.anchor[axis.index()],
            ParameterId::LengthOffset => &mut self.offset,
            ParameterId::Scale => &mut self.scale,
            id => unreachable!("{id} belongs to measured_jacobians.rs"),
        }
    }

    pub fn robot_end(&self, t_s: f64) -> Matrix<D> {
        let tau = self.clock[0] + (self.clock[1] + 1.0) * t_s;
        forward(&identity(), &self.robot, &true_joints(&self.arm, &self.joint_errors, &self.joint_waves, tau))
    }

    pub fn bar_base(&self) -> Matrix<D> {
        let place = shift(self.origin[0], self.origin[1], self.origin[2]);
        let tilted = product(&place, &turn(1, 2, self.tilt[0]));
        product(&tilted, &turn(2, 0, self.tilt[1]))
    }

    pub fn bar_joints(&self, o: &Observation) -> [D; 5] {
        std::array::from_fn(|j| {
            let b = o.bar_rad[j];
            let waves = [b.sin(), b.cos(), (2.0 * b).sin(), (2.0 * b).cos()];
            let amplitudes = self.encoder_waves[j].into_iter().flatten();
            let zero = if o.origin == 1 { self.zeros[j] } else { D::from(0.0) };
            let error = amplitudes.zip(waves).map(|(amplitude, wave)| amplitude * wave);
            D::from(b) - error.fold(D::from(0.0), |sum, error| sum + error) + zero
        })
    }

    /// The same parameters, but with the length of the bar at this observation. This length includes the deflection under
    /// the force of the observation and the harmonics of the bar's direction.
    pub fn with_length_at(&self, o: &Observation) -> Self {
        let mut elongated = self.clone();
        let Some(rod) = elongated.bar.get_mut(2) else { return elongated };
        rod[2] += self.elongation[0] * o.force.along_n + self.elongation[1] * o.force.side;
        for (b, orders) in o.bar_rad.iter().zip(self.bar_waves) {
            for (order, [sine, cosine]) in [2.0, 3.0].into_iter().zip(orders) {
                rod[2] += sine * (order * b).sin() + cosine * (order * b).cos();
            }
        }
        elongated
    }

    pub fn bar_end(&self, bar: &[D; 5]) -> Matrix<D> {
        forward(&self.bar_base(), &self.bar, bar)
    }
}

impl Numbers<Dual64> {
    pub fn without_derivative(&self) -> Self {
        let plain = |x: &Dual64| Dual64::from(x.re);
        Self {
            robot: self.robot.iter().map(|link| link.map(|x| plain(&x))).collect(),
            bar: self.bar.iter().map(|link| link.map(|x| plain(&x))).collect(),
            origin: self.origin.map(|x| plain(&x)),
            tilt: self.tilt.map(|x| plain(&x)),
            elongation: self.elongation.map(|x| plain(&x)),
            bar_waves: self.bar_waves.map(|joint| joint.map(|order| order.map(|x| plain(&x)))),
            encoder_waves: self.encoder_waves.map(|joint| joint.map(|order| order.map(|x| plain(&x)))),
            zeros: self.zeros.map(|x| plain(&x)),
            arm: self.arm.clone(),
            joint_errors: self.joint_errors.map(|axis| axis.map(|x| plain(&x))),
            joint_waves: self.joint_waves.map(|axis| axis.map(|order| order.map(|x| plain(&x)))),
            clock: self.clock.map(|x| plain(&x)),
            attachment: self.attachment.map(|x| plain(&x)),
            anchor: self.anchor.map(|x| plain(&x)),
            offset: plain(&self.offset),
            scale: plain(&self.scale),
        }
    }

    /// Chains of robot and bar in the types of the library.
    pub fn chains(&self) -> (Chain, Chain) {
        let links = |links: &[Link<Dual64>]| {
            let link = |l: &Link<Dual64>| DhLink {
                a_m: l[0].re,
                alpha_rad: l[1].re,
                d_m: l[2].re,
                theta_rad: l[3].re,
                beta_rad: l[4].re,
                ..DhLink::default()
            };
            links.iter().map(link).collect()
        };
        let base = BasePlacement {
            origin_m: self.origin.map(|x| x.re).into(),
            rx_rad: self.tilt[0].re,
            ry_rad: self.tilt[1].re,
        };
        (Chain::new(Pose::identity(), links(&self.robot)), Chain::new(base.pose(), links(&self.bar)))
    }
}
