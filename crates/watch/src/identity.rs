//! Which model a state was learned with.

use greybox_model::{Model, Unit};
use serde::{Deserialize, Serialize};

/// What a model says, part by part: its channels, states, parameters and equations, as they were read, in SI. Text that says
/// nothing of the machine (comments, spaces, the name of the model) is not part of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Identity {
    /// In the order of the file.
    parts: Vec<Part>,
}

/// One part of a model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Part {
    /// What it is, with its name.
    name: String,
    /// What the model says of it.
    says: String,
}

impl Identity {
    pub(crate) fn of(model: &Model) -> Identity {
        let mut parts = Vec::new();
        let mut part = |kind: &str, name: &str, says: String| {
            parts.push(Part { name: format!("{kind} `{name}`"), says });
        };
        for i in &model.inputs {
            let (channel, unit, hold) = (&i.channel, &i.unit.text, i.hold.name());
            part("the input", &i.name, format!("channel `{channel}` in [{unit}], hold {hold}"));
        }
        for s in &model.states {
            part("the state", &s.name, format!("order {} in [{}]", s.order, s.unit.text));
        }
        for p in &model.parameters {
            let unit = p.unit.as_ref().map_or("", |u: &Unit| u.text.as_str());
            let fixed = if p.fixed { ", fixed" } else { "" };
            let std = p.std.map_or_else(String::new, |std| format!(" ± {std:?}"));
            let sign = match p.positive {
                Some(true) => ", positive",
                Some(false) => ", of either sign",
                None => "",
            };
            part("the parameter", &p.name, format!("{:?}{std} in SI, unit [{unit}]{fixed}{sign}", p.value));
        }
        for e in &model.equations {
            part("the equation", &e.name, e.to_string());
        }
        for m in &model.measurements {
            part("the measured channel", &m.channel, format!("{} in [{}]", m.expr, m.unit.text));
        }
        Identity { parts }
    }

    /// The first part in which a state that was learned with `self` differs from `model`.
    pub(crate) fn differs_from(&self, model: &Model) -> Option<String> {
        let other = Identity::of(model);
        let find = |identity: &Identity, name: &str| {
            identity.parts.iter().find(|p| p.name == name).map(|p| p.says.clone())
        };
        for part in &other.parts {
            match find(self, &part.name) {
                None => return Some(format!("{} is not in it", part.name)),
                Some(says) if says != part.says => {
                    return Some(format!("{} is {} there, and {} in the model", part.name, says, part.says));
                }
                Some(_) => {}
            }
        }
        if let Some(part) = self.parts.iter().find(|p| find(&other, &p.name).is_none()) {
            return Some(format!("{} is not in the model", part.name));
        }
        (*self != other).then(|| "its parts are in another order".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MODEL: &str = r#"
name = "drive"
[inputs]
torque = { unit = "N*m", hold = "zero" }
[parameters]
J = { value = 0.02, unit = "kg*m^2", fixed = true }
b = { value = 0.05, unit = "N*m*s/rad" }
[states]
angle = { unit = "rad" }
[equations]
drive = "J*angle'' + b*angle' = torque"
"#;

    fn model(text: &str) -> Model {
        Model::from_toml(text, "drive.toml").unwrap()
    }

    #[test]
    fn what_says_nothing_of_the_machine_may_differ() {
        let identity = Identity::of(&model(MODEL));
        let same = MODEL.replace("name = \"drive\"", "# A comment.").replace("b*angle'", "(b * angle')");
        assert_eq!(identity.differs_from(&model(&same)), None);
        let text = serde_json::to_string(&identity).unwrap();
        assert_eq!(serde_json::from_str::<Identity>(&text).unwrap(), identity);
    }

    #[test]
    fn the_part_that_differs_is_named() {
        let identity = Identity::of(&model(MODEL));
        for (from, to, part) in [
            ("0.02", "0.03", "the parameter `J` is 0.02 in SI, unit [kg*m^2], fixed there, and 0.03"),
            ("\"zero\"", "\"linear\"", "the input `torque` is channel `torque` in [N*m], hold zero there"),
            ("{ unit = \"N*m\",", "{ channel = \"u\", unit = \"N*m\",", "and channel `u` in [N*m]"),
            ("b*angle' =", "2*b*angle' =", "the equation `drive`"),
            (
                "angle = { unit = \"rad\"",
                "angle = { channel = \"phi\", unit = \"rad\"",
                "channel `phi` is not in it",
            ),
            ("b = {", "c = { value = 1.0, unit = \"N*m\" }\nb = {", "the parameter `c` is not in it"),
        ] {
            let text = MODEL.replacen(from, to, 1);
            assert_ne!(text, MODEL, "{from}");
            let said = identity.differs_from(&model(&text)).unwrap_or_default();
            assert!(said.contains(part), "{said}");
        }
        let fewer = model(
            &MODEL.replace("b = { value = 0.05, unit = \"N*m*s/rad\" }", "").replace(" + b*angle'", ""),
        );
        let said = identity.differs_from(&fewer).unwrap();
        assert!(said.contains("the equation `drive`"), "{said}");
        let said = Identity::of(&fewer).differs_from(&model(MODEL)).unwrap();
        assert!(said.contains("the parameter `b` is not in it"), "{said}");
    }
}
