//! What the candidates of a request are made of.

/// Where the candidates come from.
pub(crate) struct Setting<'a> {
    pub states: &'a [String],
    /// Order of the leading derivative of every state.
    pub derivatives: &'a [usize],
    /// Inputs that equations may have as terms.
    pub inputs: &'a [String],
    /// Largest order of the library.
    pub orders: usize,
    /// Which of the states may be angles.
    pub angles: Vec<bool>,
    /// Names already taken.
    pub taken: Vec<String>,
}

impl Setting<'_> {
    /// A name like `base` that is not taken yet; now it is.
    pub(crate) fn name(&mut self, base: String) -> String {
        let mut name = base;
        while self.taken.contains(&name) || is_of_the_language(&name) {
            name.push('_');
        }
        self.taken.push(name.clone());
        name
    }
}

/// Whether the model language has a meaning of its own for a name.
pub(crate) fn is_of_the_language(name: &str) -> bool {
    ["t", "pi"].contains(&name) || greybox_model::Func::from_name(name).is_some()
}

/// `x` with `order` primes.
pub(crate) fn derivative(state: &str, order: usize) -> String {
    format!("{state}{}", "'".repeat(order))
}
