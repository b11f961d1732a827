//! An observer with its law, as code that is called once a sample.

use std::fmt::Write as _;

use crate::error::ExportError;
use crate::function::Function;
use crate::language::{Language, number};

/// A law that is given what sensors measure, and the observer between them. The machine's equations are ẋ = `rate`, its
/// disturbance d adds to the command.
///
/// ```
/// use greybox_export::{Function, Group, Language, Member, ObserverCode, ObserverForm};
/// use greybox_model::parse;
/// let group = |name: &str, member: &str| Group { name: name.into(), members: vec![Member::new(member, 0, "")] };
/// let function = |name: &str, arguments: Vec<Group>, output: &str| -> Result<Function, Box<dyn std::error::Error>> {
///     let outputs = vec![(String::new(), parse(output)?.expr)];
///     Ok(Function { name: name.into(), summary: vec![], arguments, constants: vec![], outputs })
/// };
/// // A tank, x' = u − x + d; its level is measured every 10 ms.
/// let state = || group("state", "x");
/// let code = ObserverCode {
///     summary: vec!["Level of a tank.".into()],
///     rate: function("plant_rate", vec![state(), group("command", "u")], "u - x")?,
///     law: function("control_law", vec![state(), group("disturbance", "d"), group("set_point", "r")], "r - 2*(x - r) - d")?,
///     dt: 0.01,
///     measured: vec![0],
///     dead_zone: 0.0,
///     substeps: 1,
///     late: (0, 0.0),
///     form: ObserverForm::Kalman { gain: vec![vec![0.4], vec![3.0]] },
/// };
/// assert!(code.code(Language::C99)?.contains("double observer_step(observer_memory *memory, const double measured[1]"));
/// assert!(code.code(Language::Rust)?.contains("pub struct Observer"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct ObserverCode {
    /// Lines of the comment at the top.
    pub summary: Vec<String>,
    /// ẋ: arguments `state` (n) and `command` (1), n outputs.
    pub rate: Function,
    /// The command: arguments `state` (n), `disturbance` (1) and `set_point` (1), one output. Its code is a file of its own.
    pub law: Function,
    /// Sample time, s.
    pub dt: f64,
    /// Indices of the measured states, in the order of the measurements.
    pub measured: Vec<usize>,
    /// Half width of the actuator's dead zone.
    pub dead_zone: f64,
    /// Classical Runge–Kutta steps of a prediction over one sample, at least one.
    pub substeps: usize,
    /// How late the command acts: whole samples, and a part of one, s.
    pub late: (usize, f64),
    /// The observer's equations.
    pub form: ObserverForm,
}

/// The equations of an observer.
#[derive(Debug, Clone, PartialEq)]
pub enum ObserverForm {
    /// Prediction by the machine's equations, then the correction (x̂, d̂) + `gain` (y − C x̂).
    Kalman {
        /// (n + 1) rows, one entry for each measurement.
        gain: Vec<Vec<f64>>,
    },
    /// Chains z⁺ = A z + b₀ y + b₁ y⁺ + g u; the last entry of each, with b u, is what its highest derivative is.
    Chains(Vec<ChainForm>),
}

/// The observer of one coordinate and its derivatives.
#[derive(Debug, Clone, PartialEq)]
pub struct ChainForm {
    /// Index of the coordinate among the states; its derivatives follow.
    pub first: usize,
    /// A, row by row: one more than the coordinate has states.
    pub a: Vec<Vec<f64>>,
    /// b₀.
    pub before: Vec<f64>,
    /// b₁.
    pub now: Vec<f64>,
    /// g.
    pub input: Vec<f64>,
    /// b, the command's gain in the highest derivative.
    pub gain: f64,
    /// Weight of this coordinate in d̂, 1/size² of its highest derivative.
    pub weight: f64,
}

impl ObserverCode {
    /// The observer's file, with the equations in it and the law called by name.
    ///
    /// # Errors
    /// As [`Function::code`].
    pub fn code(&self, language: Language) -> Result<String, ExportError> {
        self.law.check()?;
        let mut out = self.rate.code(language)?;
        out.push('\n');
        match language {
            Language::C99 => self.c(&mut out),
            Language::Rust => self.rust(&mut out),
        }
        Ok(out)
    }

    fn states(&self) -> usize {
        self.rate.outputs.len()
    }

    /// Sizes that the code needs: what each chain remembers, and where it begins.
    fn chains(&self) -> (&[ChainForm], Vec<usize>, usize) {
        let ObserverForm::Chains(chains) = &self.form else { return (&[], Vec::new(), 0) };
        let mut at = 0;
        let starts = chains
            .iter()
            .map(|chain| {
                let start = at;
                at += chain.a.len();
                start
            })
            .collect();
        (chains, starts, at)
    }

    /// Time and steps of the predictions: over the older and the newer command of a sample, and over a whole one.
    fn spans(&self) -> [(f64, usize); 3] {
        let span =
            |time: f64| (time, ((time / self.dt * self.substeps as f64 - 1e-9).ceil() as usize).max(1));
        [span(self.late.1), span(self.dt - self.late.1), span(self.dt)]
    }

    /// Whether the code predicts: a Kalman filter from sample to sample, any observer over the delay of the command.
    fn predicts(&self) -> bool {
        matches!(self.form, ObserverForm::Kalman { .. }) || self.is_late()
    }

    fn is_late(&self) -> bool {
        self.late.0 > 0 || self.late.1 > 0.0
    }

    fn c(&self, out: &mut String) {
        let (n, m, q) = (self.states(), self.measured.len(), self.late.0);
        let (chains, starts, remembered) = self.chains();
        let (law, rate) = (&self.law.name, &self.rate.name);
        for line in &self.summary {
            let _ = writeln!(out, "/* {} */", crate::language::comment(line));
        }
        let _ = write!(
            out,
            "\nvoid {law}(const double state[{n}], const double disturbance[1], const double set_point[1], double out[1]);\n\n\
             typedef struct {{\n    double estimate[{}]; /* the states, then the disturbance */\n    double command;\n    \
             double past[{}]; /* behind the dead zone, the latest first */\n    int started;\n",
            n + 1,
            q + 2,
        );
        if !chains.is_empty() {
            let _ = write!(
                out,
                "    double chain[{remembered}];\n    double last[{k}];\n    int begun[{k}];\n",
                k = chains.len()
            );
        }
        let _ = write!(
            out,
            "}} observer_memory;\n\nvoid observer_start(observer_memory *memory);\n\
             double observer_step(observer_memory *memory, const double measured[{m}], const double set_point[1]);\n\n\
             /* Before the first sample. */\nvoid observer_start(observer_memory *memory)\n{{\n    int i;\n    \
             for (i = 0; i < {}; i++) memory->estimate[i] = 0.0;\n    for (i = 0; i < {}; i++) memory->past[i] = 0.0;\n    \
             memory->command = 0.0;\n    memory->started = 0;\n",
            n + 1,
            q + 2,
        );
        if !chains.is_empty() {
            let _ = write!(
                out,
                "    for (i = 0; i < {remembered}; i++) memory->chain[i] = 0.0;\n    \
                 for (i = 0; i < {k}; i++) {{ memory->last[i] = 0.0; memory->begun[i] = 0; }}\n",
                k = chains.len()
            );
        }
        out.push_str("}\n\n");
        if self.predicts() {
            let _ = write!(
                out,
                "/* The states a time later under a command: classical Runge-Kutta steps. */\n\
                 static void predict(double x[{}], double command, double time, int steps)\n{{\n    \
                 const double h = time / steps;\n    double k1[{n}], k2[{n}], k3[{n}], k4[{n}], at[{n}], input[1];\n    int i, j;\n    \
                 input[0] = command + x[{n}];\n    for (j = 0; j < steps; j++) {{\n        {rate}(x, input, k1);\n        \
                 for (i = 0; i < {n}; i++) at[i] = x[i] + 0.5 * h * k1[i];\n        {rate}(at, input, k2);\n        \
                 for (i = 0; i < {n}; i++) at[i] = x[i] + 0.5 * h * k2[i];\n        {rate}(at, input, k3);\n        \
                 for (i = 0; i < {n}; i++) at[i] = x[i] + h * k3[i];\n        {rate}(at, input, k4);\n        \
                 for (i = 0; i < {n}; i++)\n            \
                 x[i] = x[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);\n    }}\n}}\n\n",
                n + 1
            );
        }
        let places = list(self.measured.iter().map(usize::to_string));
        let _ = write!(
            out,
            "/* Once a sample, every {} s: the command from the measurements and the set point. A measurement that is not a\n   \
             number is left out. */\n\
             double observer_step(observer_memory *memory, const double measured[{m}], const double set_point[1])\n{{\n    \
             static const int place[{m}] = {{{places}}};\n    double *x = memory->estimate, *past = memory->past;\n    \
             const double u = memory->command;\n    const double gap = {};\n    double out[1];\n    int i;\n    \
             for (i = {}; i > 0; i--) past[i] = past[i - 1];\n    \
             past[0] = u > gap ? u - gap : u < -gap ? u + gap : 0.0;\n    \
             if (!memory->started) {{\n        for (i = 0; i < {m}; i++)\n            \
             x[place[i]] = measured[i] - measured[i] == 0.0 ? measured[i] : 0.0;\n    }}",
            number(self.dt),
            number(self.dead_zone),
            q + 1,
        );
        let [older, newer, whole] = self.spans();
        let call = |x: &str, past: &str, (time, steps): (f64, usize)| {
            format!("predict({x}, past[{past}], {}, {steps});\n", number(time))
        };
        match &self.form {
            ObserverForm::Kalman { gain } => {
                let rows =
                    list(gain.iter().map(|row| format!("{{{}}}", list(row.iter().map(|v| number(*v))))));
                let _ = write!(
                    out,
                    " else {{\n        static const double gain[{}][{m}] = {{{rows}}};\n        double innovation[{m}];\n        int j;\n",
                    n + 1,
                );
                if older.0 > 0.0 {
                    let _ = write!(out, "        {}", call("x", &(q + 1).to_string(), older));
                }
                let _ = write!(
                    out,
                    "        {}        for (i = 0; i < {m}; i++)\n            \
                     innovation[i] = measured[i] - measured[i] == 0.0 ? measured[i] - x[place[i]] : 0.0;\n        \
                     for (i = 0; i < {}; i++)\n            \
                     for (j = 0; j < {m}; j++) x[i] += gain[i][j] * innovation[j];\n    }}\n",
                    call("x", &q.to_string(), newer),
                    n + 1,
                );
            }
            ObserverForm::Chains(chains) => {
                let _ = write!(
                    out,
                    "\n    {{\n        const double acting = {};\n        \
                     double lumped, above = 0.0, below = 0.0, rest[{n}], moved[{n}], input[1];\n",
                    self.acting("past")
                );
                for (k, (chain, start)) in chains.iter().zip(&starts).enumerate() {
                    self.c_chain(out, k, chain, *start);
                }
                let _ = write!(
                    out,
                    "        input[0] = acting;\n        {rate}(x, input, rest);\n        input[0] = acting + 1.0;\n        \
                     {rate}(x, input, moved);\n"
                );
                for (chain, start) in chains.iter().zip(&starts) {
                    let order = chain.a.len() - 1;
                    let row = chain.first + order - 1;
                    let _ = write!(
                        out,
                        "        lumped = memory->chain[{}] + {} * acting;\n        \
                         above += {w} * (moved[{row}] - rest[{row}]) * (lumped - rest[{row}]);\n        \
                         below += {w} * (moved[{row}] - rest[{row}]) * (moved[{row}] - rest[{row}]);\n",
                        start + order,
                        number(chain.gain),
                        w = number(chain.weight),
                    );
                }
                let _ = write!(out, "        x[{n}] = below > 0.0 ? above / below : 0.0;\n    }}\n");
            }
        }
        out.push_str("    memory->started = 1;\n");
        if self.is_late() {
            let _ = write!(
                out,
                "    /* The law acts on the states that its command will meet. */\n    {{\n        double ahead[{}];\n        \
                 for (i = 0; i < {}; i++) ahead[i] = x[i];\n",
                n + 1,
                n + 1
            );
            if older.0 > 0.0 {
                let _ = write!(out, "        {}", call("ahead", &q.to_string(), older));
            }
            if q > 0 {
                let _ = write!(out, "        for (i = {q}; i > 0; i--) {}", call("ahead", "i - 1", whole));
            }
            let _ = write!(out, "        {law}(ahead, ahead + {n}, set_point, out);\n    }}\n");
        } else {
            let _ = writeln!(out, "    {law}(x, x + {n}, set_point, out);");
        }
        out.push_str("    memory->command = out[0];\n    return out[0];\n}\n");
    }

    /// The mean command since the last sample.
    fn acting(&self, past: &str) -> String {
        let (q, part) = self.late;
        if part == 0.0 {
            return format!("{past}[{q}]");
        }
        let share = part / self.dt;
        format!("{} * {past}[{}] + (1.0 - {}) * {past}[{q}]", number(share), q + 1, number(share))
    }

    fn c_chain(&self, out: &mut String, k: usize, chain: &ChainForm, start: usize) {
        let size = chain.a.len();
        let at = self.measured.iter().position(|i| *i == chain.first).unwrap_or(0);
        let row = |row: &[f64]| format!("{{{}}}", list(row.iter().map(|v| number(*v))));
        let _ = write!(
            out,
            "        {{\n            static const double a[{size}][{size}] = {{{}}};\n            \
             static const double before[{size}] = {}, now[{size}] = {}, g[{size}] = {};\n            \
             double *z = memory->chain + {start};\n            double next[{size}], y = measured[{at}];\n            \
             const int known = y - y == 0.0;\n            int j;\n            \
             if (memory->begun[{k}]) {{\n                for (i = 0; i < {size}; i++) {{\n                    \
             next[i] = before[i] * memory->last[{k}] + g[i] * acting;\n                    \
             for (j = 0; j < {size}; j++) next[i] += a[i][j] * z[j];\n                }}\n                \
             /* Without a measurement, the one that is expected. */\n                \
             if (!known) y = next[0] / (1.0 - now[0]);\n                \
             for (i = 0; i < {size}; i++) z[i] = next[i] + now[i] * y;\n                memory->last[{k}] = y;\n            \
             }} else if (known) {{\n                z[0] = y;\n                memory->last[{k}] = y;\n                \
             memory->begun[{k}] = 1;\n            }}\n            \
             for (i = 0; i < {}; i++) x[{} + i] = z[i];\n        }}\n",
            list(chain.a.iter().map(|r| row(r))),
            row(&chain.before),
            row(&chain.now),
            row(&chain.input),
            size - 1,
            chain.first,
        );
    }

    fn rust(&self, out: &mut String) {
        let (n, m, q) = (self.states(), self.measured.len(), self.late.0);
        let (chains, starts, remembered) = self.chains();
        let rate = &self.rate.name;
        for line in &self.summary {
            let _ = writeln!(out, "// {}", crate::language::comment(line));
        }
        let mut fields = format!(
            "    /// The states, then the disturbance.\n    pub estimate: [f64; {}],\n    command: f64,\n    \
             /// Behind the dead zone, the latest first.\n    past: [f64; {}],\n    started: bool,\n",
            n + 1,
            q + 2
        );
        let mut zeros = format!(
            "            estimate: [0.0; {}],\n            command: 0.0,\n            past: [0.0; {}],\n            started: false,\n",
            n + 1,
            q + 2
        );
        if !chains.is_empty() {
            let k = chains.len();
            let _ = write!(
                fields,
                "    chain: [f64; {remembered}],\n    last: [f64; {k}],\n    begun: [bool; {k}],\n"
            );
            let _ = write!(
                zeros,
                "            chain: [0.0; {remembered}],\n            last: [0.0; {k}],\n            begun: [false; {k}],\n"
            );
        }
        out.push('\n');
        if self.predicts() {
            let _ = write!(
                out,
                "/// The states a time later under a command: classical Runge-Kutta steps.\n#[allow(clippy::all)]\n\
                 fn predict(estimate: &mut [f64; {}], command: f64, time: f64, steps: u32) {{\n    \
                 let h = time / f64::from(steps);\n    let input = [command + estimate[{n}]];\n    \
                 let mut x = [0.0; {n}];\n    x.copy_from_slice(&estimate[..{n}]);\n    for _ in 0..steps {{\n        \
                 let k1 = {rate}(&x, &input);\n        \
                 let k2 = {rate}(&core::array::from_fn(|i| x[i] + 0.5 * h * k1[i]), &input);\n        \
                 let k3 = {rate}(&core::array::from_fn(|i| x[i] + 0.5 * h * k2[i]), &input);\n        \
                 let k4 = {rate}(&core::array::from_fn(|i| x[i] + h * k3[i]), &input);\n        for i in 0..{n} {{\n            \
                 x[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);\n        }}\n    }}\n    \
                 estimate[..{n}].copy_from_slice(&x);\n}}\n\n",
                n + 1
            );
        }
        let places = list(self.measured.iter().map(usize::to_string));
        let _ = write!(
            out,
            "/// What the observer remembers between two samples.\n#[derive(Clone, Copy, Debug, PartialEq)]\n\
             pub struct Observer {{\n{fields}}}\n\n\
             #[allow(clippy::all)]\nimpl Observer {{\n    /// Before the first sample.\n    #[must_use]\n    \
             pub const fn new() -> Observer {{\n        Observer {{\n{zeros}        }}\n    }}\n\n    \
             /// Once a sample, every {} s: the command from the measurements and the set point. A measurement that is not a\n    \
             /// number is left out. `law` is `{}`.\n    pub fn step(\n        &mut self,\n        measured: &[f64; {m}],\n        \
             set_point: &[f64; 1],\n        law: impl Fn(&[f64; {n}], &[f64; 1], &[f64; 1]) -> [f64; 1],\n    ) -> f64 {{\n        \
             const PLACE: [usize; {m}] = [{places}];\n        const GAP: f64 = {};\n        let u = self.command;\n        \
             self.past.copy_within(0..{}, 1);\n        \
             self.past[0] = if u > GAP {{ u - GAP }} else if u < -GAP {{ u + GAP }} else {{ 0.0 }};\n        \
             if !self.started {{\n            for i in 0..{m} {{\n                \
             self.estimate[PLACE[i]] = if measured[i].is_finite() {{ measured[i] }} else {{ 0.0 }};\n            }}\n        }}",
            number(self.dt),
            self.law.name,
            number(self.dead_zone),
            q + 1,
        );
        let [older, newer, whole] = self.spans();
        let call = |x: &str, past: &str, (time, steps): (f64, usize)| {
            format!("predict(&mut {x}, self.past[{past}], {}, {steps});\n", number(time))
        };
        match &self.form {
            ObserverForm::Kalman { gain } => {
                let rows = list(gain.iter().map(|row| format!("[{}]", list(row.iter().map(|v| number(*v))))));
                let _ =
                    writeln!(out, " else {{\n            const GAIN: [[f64; {m}]; {}] = [{rows}];", n + 1);
                if older.0 > 0.0 {
                    let _ = write!(out, "            {}", call("self.estimate", &(q + 1).to_string(), older));
                }
                let _ = write!(
                    out,
                    "            {}            let innovation: [f64; {m}] = core::array::from_fn(|i| {{\n                \
                     if measured[i].is_finite() {{ measured[i] - self.estimate[PLACE[i]] }} else {{ 0.0 }}\n            }});\n            \
                     for i in 0..{} {{\n                for j in 0..{m} {{\n                    \
                     self.estimate[i] += GAIN[i][j] * innovation[j];\n                }}\n            }}\n        }}\n",
                    call("self.estimate", &q.to_string(), newer),
                    n + 1,
                );
            }
            ObserverForm::Chains(chains) => {
                let _ = write!(out, "\n        let acting = {};\n", self.acting("self.past"));
                for (k, (chain, start)) in chains.iter().zip(&starts).enumerate() {
                    self.rust_chain(out, k, chain, *start);
                }
                let _ = write!(
                    out,
                    "        let mut x = [0.0; {n}];\n        x.copy_from_slice(&self.estimate[..{n}]);\n        \
                     let rest = {rate}(&x, &[acting]);\n        let moved = {rate}(&x, &[acting + 1.0]);\n        \
                     let (mut above, mut below) = (0.0, 0.0);\n",
                );
                for (chain, start) in chains.iter().zip(&starts) {
                    let order = chain.a.len() - 1;
                    let row = chain.first + order - 1;
                    let _ = write!(
                        out,
                        "        let lumped = self.chain[{}] + {} * acting;\n        \
                         above += {w} * (moved[{row}] - rest[{row}]) * (lumped - rest[{row}]);\n        \
                         below += {w} * (moved[{row}] - rest[{row}]) * (moved[{row}] - rest[{row}]);\n",
                        start + order,
                        number(chain.gain),
                        w = number(chain.weight),
                    );
                }
                let _ = writeln!(
                    out,
                    "        self.estimate[{n}] = if below > 0.0 {{ above / below }} else {{ 0.0 }};"
                );
            }
        }
        out.push_str("        self.started = true;\n");
        if self.is_late() {
            out.push_str(
                "        // The law acts on the states that its command will meet.\n        let mut ahead = self.estimate;\n",
            );
            if older.0 > 0.0 {
                let _ = write!(out, "        {}", call("ahead", &q.to_string(), older));
            }
            if q > 0 {
                let _ = write!(
                    out,
                    "        for i in (0..{q}).rev() {{\n            {}        }}\n",
                    call("ahead", "i", whole)
                );
            }
        } else {
            out.push_str("        let ahead = self.estimate;\n");
        }
        let _ = write!(
            out,
            "        let mut x = [0.0; {n}];\n        x.copy_from_slice(&ahead[..{n}]);\n        \
             self.command = law(&x, &[ahead[{n}]], set_point)[0];\n        self.command\n    }}\n}}\n\n\
             impl Default for Observer {{\n    fn default() -> Self {{\n        Self::new()\n    }}\n}}\n",
        );
    }

    fn rust_chain(&self, out: &mut String, k: usize, chain: &ChainForm, start: usize) {
        let size = chain.a.len();
        let at = self.measured.iter().position(|i| *i == chain.first).unwrap_or(0);
        let row = |row: &[f64]| format!("[{}]", list(row.iter().map(|v| number(*v))));
        let _ = write!(
            out,
            "        {{\n            const A: [[f64; {size}]; {size}] = [{}];\n            \
             const BEFORE: [f64; {size}] = {};\n            const NOW: [f64; {size}] = {};\n            \
             const G: [f64; {size}] = {};\n            let z = &mut self.chain[{start}..{}];\n            \
             let mut y = measured[{at}];\n            let known = y.is_finite();\n            if self.begun[{k}] {{\n                \
             let mut next = [0.0; {size}];\n                for i in 0..{size} {{\n                    \
             next[i] = BEFORE[i] * self.last[{k}] + G[i] * acting;\n                    \
             for j in 0..{size} {{\n                        next[i] += A[i][j] * z[j];\n                    }}\n                }}\n                \
             // Without a measurement, the one that is expected.\n                \
             if !known {{\n                    y = next[0] / (1.0 - NOW[0]);\n                }}\n                \
             for i in 0..{size} {{\n                    z[i] = next[i] + NOW[i] * y;\n                }}\n                \
             self.last[{k}] = y;\n            }} else if known {{\n                z[0] = y;\n                \
             self.last[{k}] = y;\n                self.begun[{k}] = true;\n            }}\n            \
             for i in 0..{} {{\n                self.estimate[{} + i] = z[i];\n            }}\n        }}\n",
            list(chain.a.iter().map(|r| row(r))),
            row(&chain.before),
            row(&chain.now),
            row(&chain.input),
            start + size,
            size - 1,
            chain.first,
        );
    }
}

fn list(entries: impl Iterator<Item = String>) -> String {
    entries.collect::<Vec<_>>().join(", ")
}
