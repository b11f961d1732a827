//! An observer with its law, as code that is called once a sample.

use std::fmt::Write as _;

use crate::error::ExportError;
use crate::function::Function;
use crate::language::{Language, number};

/// A law that is given what sensors measure, and the observer between them. The machine's equations are ẋ = `rate`, its
/// disturbance d adds to the command.
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
    /// The observer's equations.
    pub form: ObserverForm,
}

/// The equations of an observer.
#[derive(Debug, Clone, PartialEq)]
pub enum ObserverForm {
    /// Prediction by the machine's equations, `substeps` classical Runge–Kutta steps, then the correction
    /// (x̂, d̂) + `gain` (y − C x̂).
    Kalman {
        /// (n + 1) rows, one entry for each measurement.
        gain: Vec<Vec<f64>>,
        /// At least one.
        substeps: usize,
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

    fn c(&self, out: &mut String) {
        let (n, m) = (self.states(), self.measured.len());
        let (chains, starts, remembered) = self.chains();
        let (law, rate) = (&self.law.name, &self.rate.name);
        for line in &self.summary {
            let _ = writeln!(out, "/* {} */", crate::language::comment(line));
        }
        let _ = write!(
            out,
            "\nvoid {law}(const double state[{n}], const double disturbance[1], const double set_point[1], double out[1]);\n\n\
             typedef struct {{\n    double estimate[{}]; /* the states, then the disturbance */\n    \
             double command;\n    int started;\n",
            n + 1
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
             for (i = 0; i < {}; i++) memory->estimate[i] = 0.0;\n    \
             memory->command = 0.0;\n    memory->started = 0;\n",
            n + 1
        );
        if !chains.is_empty() {
            let _ = write!(
                out,
                "    for (i = 0; i < {remembered}; i++) memory->chain[i] = 0.0;\n    \
                 for (i = 0; i < {k}; i++) {{ memory->last[i] = 0.0; memory->begun[i] = 0; }}\n",
                k = chains.len()
            );
        }
        let places = list(self.measured.iter().map(usize::to_string));
        let _ = write!(
            out,
            "}}\n\n/* Once a sample, every {} s: the command from the measurements and the set point. A measurement that is not a\n   \
             number is left out. */\n\
             double observer_step(observer_memory *memory, const double measured[{m}], const double set_point[1])\n{{\n    \
             static const int place[{m}] = {{{places}}};\n    double *x = memory->estimate;\n    \
             const double u = memory->command;\n    const double gap = {};\n    \
             const double acting = u > gap ? u - gap : u < -gap ? u + gap : 0.0;\n    double out[1];\n    int i;\n    \
             if (!memory->started) {{\n        for (i = 0; i < {m}; i++)\n            \
             x[place[i]] = measured[i] - measured[i] == 0.0 ? measured[i] : 0.0;\n    }}",
            number(self.dt),
            number(self.dead_zone),
        );
        match &self.form {
            ObserverForm::Kalman { gain, substeps } => {
                let rows =
                    list(gain.iter().map(|row| format!("{{{}}}", list(row.iter().map(|v| number(*v))))));
                let _ = write!(
                    out,
                    " else {{\n        static const double gain[{}][{m}] = {{{rows}}};\n        \
                     const double h = {};\n        double k1[{n}], k2[{n}], k3[{n}], k4[{n}], at[{n}], innovation[{m}];\n        \
                     double input[1];\n        int j;\n        input[0] = acting + x[{n}];\n        \
                     for (j = 0; j < {substeps}; j++) {{\n            {rate}(x, input, k1);\n            \
                     for (i = 0; i < {n}; i++) at[i] = x[i] + 0.5 * h * k1[i];\n            {rate}(at, input, k2);\n            \
                     for (i = 0; i < {n}; i++) at[i] = x[i] + 0.5 * h * k2[i];\n            {rate}(at, input, k3);\n            \
                     for (i = 0; i < {n}; i++) at[i] = x[i] + h * k3[i];\n            {rate}(at, input, k4);\n            \
                     for (i = 0; i < {n}; i++)\n                \
                     x[i] = x[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);\n        }}\n        \
                     for (i = 0; i < {m}; i++)\n            \
                     innovation[i] = measured[i] - measured[i] == 0.0 ? measured[i] - x[place[i]] : 0.0;\n        \
                     for (i = 0; i < {}; i++)\n            \
                     for (j = 0; j < {m}; j++) x[i] += gain[i][j] * innovation[j];\n    }}\n",
                    n + 1,
                    number(self.dt / *substeps as f64),
                    n + 1,
                );
            }
            ObserverForm::Chains(chains) => {
                let _ = write!(
                    out,
                    "\n    {{\n        double lumped, above = 0.0, below = 0.0, rest[{n}], moved[{n}], input[1];\n"
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
        let _ = write!(
            out,
            "    memory->started = 1;\n    {law}(x, x + {n}, set_point, out);\n    \
             memory->command = out[0];\n    return out[0];\n}}\n"
        );
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
        let (n, m) = (self.states(), self.measured.len());
        let (chains, starts, remembered) = self.chains();
        let rate = &self.rate.name;
        for line in &self.summary {
            let _ = writeln!(out, "// {}", crate::language::comment(line));
        }
        let mut fields = format!(
            "    /// The states, then the disturbance.\n    pub estimate: [f64; {}],\n    command: f64,\n    \
             started: bool,\n",
            n + 1
        );
        let mut zeros = format!(
            "            estimate: [0.0; {}],\n            command: 0.0,\n            started: false,\n",
            n + 1
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
        let places = list(self.measured.iter().map(usize::to_string));
        let _ = write!(
            out,
            "\n/// What the observer remembers between two samples.\n#[derive(Clone, Copy, Debug, PartialEq)]\n\
             pub struct Observer {{\n{fields}}}\n\n\
             #[allow(clippy::all)]\nimpl Observer {{\n    /// Before the first sample.\n    #[must_use]\n    \
             pub const fn new() -> Observer {{\n        Observer {{\n{zeros}        }}\n    }}\n\n    \
             /// Once a sample, every {} s: the command from the measurements and the set point. A measurement that is not a\n    \
             /// number is left out. `law` is `{}`.\n    pub fn step(\n        &mut self,\n        measured: &[f64; {m}],\n        \
             set_point: &[f64; 1],\n        law: impl Fn(&[f64; {n}], &[f64; 1], &[f64; 1]) -> [f64; 1],\n    ) -> f64 {{\n        \
             const PLACE: [usize; {m}] = [{places}];\n        const GAP: f64 = {};\n        let u = self.command;\n        \
             let acting = if u > GAP {{ u - GAP }} else if u < -GAP {{ u + GAP }} else {{ 0.0 }};\n        \
             if !self.started {{\n            for i in 0..{m} {{\n                \
             self.estimate[PLACE[i]] = if measured[i].is_finite() {{ measured[i] }} else {{ 0.0 }};\n            }}\n        }}",
            number(self.dt),
            self.law.name,
            number(self.dead_zone),
        );
        let states = format!("let mut x = [0.0; {n}];\n{{0}}x.copy_from_slice(&self.estimate[..{n}]);\n");
        match &self.form {
            ObserverForm::Kalman { gain, substeps } => {
                let rows = list(gain.iter().map(|row| format!("[{}]", list(row.iter().map(|v| number(*v))))));
                let _ = write!(
                    out,
                    " else {{\n            const GAIN: [[f64; {m}]; {}] = [{rows}];\n            const H: f64 = {};\n            \
                     let input = [acting + self.estimate[{n}]];\n            {}            \
                     for _ in 0..{substeps} {{\n                let k1 = {rate}(&x, &input);\n                \
                     let k2 = {rate}(&core::array::from_fn(|i| x[i] + 0.5 * H * k1[i]), &input);\n                \
                     let k3 = {rate}(&core::array::from_fn(|i| x[i] + 0.5 * H * k2[i]), &input);\n                \
                     let k4 = {rate}(&core::array::from_fn(|i| x[i] + H * k3[i]), &input);\n                \
                     for i in 0..{n} {{\n                    \
                     x[i] += H / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);\n                }}\n            }}\n            \
                     self.estimate[..{n}].copy_from_slice(&x);\n            \
                     let innovation: [f64; {m}] = core::array::from_fn(|i| {{\n                \
                     if measured[i].is_finite() {{ measured[i] - x[PLACE[i]] }} else {{ 0.0 }}\n            }});\n            \
                     for i in 0..{} {{\n                for j in 0..{m} {{\n                    \
                     self.estimate[i] += GAIN[i][j] * innovation[j];\n                }}\n            }}\n        }}\n",
                    n + 1,
                    number(self.dt / *substeps as f64),
                    states.replace("{0}", "            "),
                    n + 1,
                );
            }
            ObserverForm::Chains(chains) => {
                out.push('\n');
                for (k, (chain, start)) in chains.iter().zip(&starts).enumerate() {
                    self.rust_chain(out, k, chain, *start);
                }
                let _ = write!(
                    out,
                    "        {}        let rest = {rate}(&x, &[acting]);\n        \
                     let moved = {rate}(&x, &[acting + 1.0]);\n        let (mut above, mut below) = (0.0, 0.0);\n",
                    states.replace("{0}", "        "),
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
        let _ = write!(
            out,
            "        self.started = true;\n        {}        \
             self.command = law(&x, &[self.estimate[{n}]], set_point)[0];\n        self.command\n    }}\n}}\n\n\
             impl Default for Observer {{\n    fn default() -> Self {{\n        Self::new()\n    }}\n}}\n",
            states.replace("{0}", "        "),
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
