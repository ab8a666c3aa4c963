//! Reads the links and joints of a URDF file. Shapes, materials, masses, transmissions and extensions of simulators are
//! skipped without checks. Attributes are stored as text. A number is parsed only when it is requested, so errors in joints
//! outside the arm do not matter.

use std::f64::consts::{FRAC_PI_2, PI};

use quick_xml::events::{BytesStart, Event};
use quick_xml::{Reader, XmlVersion};

use super::import::ImportError;

/// The links and joints of a URDF file, with the file's order and names.
pub(super) struct Urdf {
    pub(super) name: String,
    pub(super) links: Vec<String>,
    pub(super) joints: Vec<UrdfJoint>,
}

/// A joint between two links.
#[derive(Default)]
pub(super) struct UrdfJoint {
    pub(super) name: String,
    /// Type of the joint, such as `revolute` or `fixed`.
    pub(super) kind: String,
    pub(super) parent: String,
    pub(super) child: String,
    /// Child elements of the joint, such as `origin`, each with the names and values of its attributes.
    elements: Vec<(String, Vec<(String, String)>)>,
}

impl Urdf {
    pub(super) fn read(text: &str) -> Result<Self, ImportError> {
        // A binary file contains control characters. They are escaped, because they must not be printed on a terminal.
        let not_urdf = |problem: String| ImportError::NotUrdf(problem.escape_debug().to_string());
        let mut is_begun = false;
        let mut urdf = Self { name: String::new(), links: Vec::new(), joints: Vec::new() };
        let mut reader = Reader::from_str(text);
        let mut open: Vec<String> = Vec::new();
        loop {
            let event = reader.read_event().map_err(|error| not_urdf(error.to_string()))?;
            match event {
                Event::Start(tag) => {
                    is_begun = true;
                    urdf.add_element(&open, &tag)?;
                    open.push(tag.name().as_ref().to_owned());
                }
                Event::Empty(tag) => {
                    is_begun = true;
                    urdf.add_element(&open, &tag)?;
                }
                Event::End(_) => drop(open.pop()),
                Event::Eof => break,
                _ => {}
            }
        }
        if let Some(element) = open.pop() {
            return Err(not_urdf(format!("it ends within <{element}>")));
        }
        if !is_begun {
            return Err(not_urdf("it has no <robot> element".to_owned()));
        }
        for joint in &mut urdf.joints {
            let link = |element: &str| joint.value(element, "link").unwrap_or_default().to_owned();
            (joint.parent, joint.child) = (link("parent"), link("child"));
        }
        Ok(urdf)
    }

    /// Stores a link, a joint, or a child element of a joint, from its start tag. `open` contains the names of the
    /// enclosing elements, outermost first.
    fn add_element(&mut self, open: &[String], tag: &BytesStart<'_>) -> Result<(), ImportError> {
        let name = tag.name();
        let name = name.as_ref();
        if name.starts_with("xacro:") {
            return Err(ImportError::Xacro(name.to_owned()));
        }
        let open: Vec<&str> = open.iter().map(String::as_str).collect();
        match (open.as_slice(), name) {
            ([], "robot") => self.name = attribute(&attributes(tag)?, "name"),
            ([], other) => {
                let other = other.escape_debug();
                return Err(ImportError::NotUrdf(format!("its first element is <{other}>, not <robot>")));
            }
            (["robot"], "link") => self.links.push(attribute(&attributes(tag)?, "name")),
            (["robot"], "joint") => {
                let attributes = attributes(tag)?;
                let [name, kind] = ["name", "type"].map(|key| attribute(&attributes, key));
                self.joints.push(UrdfJoint { name, kind, ..UrdfJoint::default() });
            }
            (["robot", "joint"], "parent" | "child" | "origin" | "axis" | "limit" | "mimic") => {
                if let Some(joint) = self.joints.last_mut() {
                    joint.elements.push((name.to_owned(), attributes(tag)?));
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// The joints from the root of the tree to a link, root first.
    pub(super) fn joints_to(&self, link: &str) -> Vec<&UrdfJoint> {
        let (mut joints, mut link): (Vec<&UrdfJoint>, _) = (Vec::new(), link);
        // If the links form a circle, no root exists. The search then ends after as many joints as the file has.
        while let Some(joint) =
            self.joints.iter().find(|joint| joint.child == link).filter(|_| joints.len() < self.joints.len())
        {
            joints.push(joint);
            link = &joint.parent;
        }
        joints.reverse();
        joints
    }
}

impl UrdfJoint {
    /// The value of an attribute of a child element; `None` if the joint does not have it.
    pub(super) fn value(&self, element: &str, attribute: &str) -> Option<&str> {
        let (_, attributes) = self.elements.iter().find(|(name, _)| name == element)?;
        attributes.iter().find(|(key, _)| key == attribute).map(|(_, value)| value.as_str())
    }

    pub(super) fn moves(&self) -> bool {
        self.kind != "fixed"
    }

    /// Direction of the joint's axis, not normalised. If the file does not define an axis, the direction is x.
    pub(super) fn axis(&self) -> Result<[f64; 3], ImportError> {
        let is_given = self.elements.iter().any(|(name, _)| name == "axis");
        self.numbers("axis", "xyz", (!is_given).then_some([1.0, 0.0, 0.0]), |text| text.parse().ok())
    }

    /// The joint's origin in its parent link: position \[m\], then roll, pitch and yaw \[rad\], which [`angle_rad`] parses.
    pub(super) fn origin(&self) -> Result<[[f64; 3]; 2], ImportError> {
        let xyz_m = self.numbers("origin", "xyz", Some([0.0; 3]), |text| text.parse().ok())?;
        Ok([xyz_m, self.numbers("origin", "rpy", Some([0.0; 3]), angle_rad)?])
    }

    fn numbers(
        &self,
        element: &str,
        attribute: &str,
        default: Option<[f64; 3]>,
        read: fn(&str) -> Option<f64>,
    ) -> Result<[f64; 3], ImportError> {
        let wrong = |what: String| ImportError::Wrong(format!("joint `{}` has {what}", self.name));
        let Some(text) = self.value(element, attribute) else {
            return default.ok_or_else(|| wrong(format!("an {element} without {attribute}")));
        };
        let numbers: Option<Vec<f64>> = text.split_whitespace().map(read).collect();
        let numbers = numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
        let numbers = numbers.ok_or_else(|| wrong(format!("`{text}` as {attribute} of its {element}")))?;
        match numbers.iter().find(|number| !number.is_finite()) {
            Some(number) => Err(wrong(format!("{number} in its origin or axis"))),
            None => Ok(numbers),
        }
    }
}

/// Angles with at least this number of decimals are written precisely. If an angle has fewer decimals, its replacement by
/// the exact angle changes the pose by more than the repeatability of a robot.
pub(super) const DECIMALS_FINE: usize = 4;

/// Parses an angle \[rad\], and corrects angles that were rounded in the file. The angle is compared with the nearest
/// multiple of 90 degrees, or of 15 degrees if it has at least [`DECIMALS_FINE`] decimals. If both agree in all digits of
/// the file, the exact multiple is returned. With six or more decimals, the last digit may differ by less than two. Angles
/// with fewer than two decimals are never corrected.
pub(super) fn angle_rad(text: &str) -> Option<f64> {
    /// Decimals beyond this number exceed the resolution of a double.
    const DECIMALS_MAX: usize = 14;
    let written: f64 = text.parse().ok()?;
    let decimals = decimals(text).min(DECIMALS_MAX);
    let step = if decimals >= DECIMALS_FINE { PI / 12.0 } else { FRAC_PI_2 };
    let exact = (written / step).round() * step;
    // The inverse of the value of the last digit.
    let scale = 10f64.powi(decimals as i32);
    // Some files round angles, others truncate them. Many files contain 1.570796325, which is neither.
    let digits = [(exact * scale).round(), (exact * scale).trunc()];
    let is_exact = match decimals {
        0 | 1 => false,
        2..6 => digits.contains(&(written * scale).round()),
        _ => ((written - exact) * scale).abs() < 2.0,
    };
    Some(if is_exact { exact } else { written })
}

/// Number of digits after the decimal point; zero for exponential notation.
pub(super) fn decimals(text: &str) -> usize {
    let digits = text.split_once('.').map_or("", |(_, decimals)| decimals);
    if digits.bytes().all(|digit| digit.is_ascii_digit()) { digits.len() } else { 0 }
}

fn attributes(tag: &BytesStart<'_>) -> Result<Vec<(String, String)>, ImportError> {
    let mut attributes = Vec::new();
    for attribute in tag.attributes() {
        let attribute = attribute.map_err(|error| ImportError::NotUrdf(error.to_string()))?;
        let value = attribute.normalized_value(XmlVersion::Implicit1_0);
        let value = value.map_err(|error| ImportError::NotUrdf(error.to_string()))?;
        attributes.push((attribute.key.as_ref().to_owned(), value.into_owned()));
    }
    Ok(attributes)
}

fn attribute(attributes: &[(String, String)], name: &str) -> String {
    attributes.iter().find(|(key, _)| key == name).map(|(_, value)| value.clone()).unwrap_or_default()
}
