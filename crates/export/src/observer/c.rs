//! An observer in C99.

use super::fill::{fill, list};
use super::{ChainText, ObserverCode, ObserverForm};
use crate::language::number;

const MEMORY: &str = "
void @LAW@(const double state[@N@], const double disturbance[1], const double set_point[@R@], double out[1]);

typedef struct {
    double estimate[@N1@]; /* the states, then the disturbance */
    double command;
    double past[@PAST@]; /* behind the dead zone, the latest first */
    int started;
@CHAINS@@REST@} observer_memory;

void observer_start(observer_memory *memory);
int observer_start_at(observer_memory *memory, const double measured[@M@], double command);
double observer_step(observer_memory *memory, const double measured[@M@], const double set_point[@R@]);

/* Before the first sample. */
void observer_start(observer_memory *memory)
{
    int i;
    for (i = 0; i < @N1@; i++) memory->estimate[i] = 0.0;
    for (i = 0; i < @PAST@; i++) memory->past[i] = 0.0;
    memory->command = 0.0;
    memory->started = 0;
@START@@UNMOVED@}

";

const CHAINS: &str = "    double chain[@SIZE@];
    double last[@K@];
    int begun[@K@];
";

const START: &str = "    for (i = 0; i < @SIZE@; i++) memory->chain[i] = 0.0;
    for (i = 0; i < @K@; i++) { memory->last[i] = 0.0; memory->begun[i] = 0; }
";

const PREDICT: &str = "/* The states a time later under a command: classical Runge-Kutta steps. */
static void predict(double x[@N1@], double command, double time, int steps)
{
    const double h = time / steps;
    double k1[@N@], k2[@N@], k3[@N@], k4[@N@], at[@N@], input[1];
    int i, j;
    input[0] = command + x[@N@];
    for (j = 0; j < steps; j++) {
        @RATE@(x, input, k1);
        for (i = 0; i < @N@; i++) at[i] = x[i] + 0.5 * h * k1[i];
        @RATE@(at, input, k2);
        for (i = 0; i < @N@; i++) at[i] = x[i] + 0.5 * h * k2[i];
        @RATE@(at, input, k3);
        for (i = 0; i < @N@; i++) at[i] = x[i] + h * k3[i];
        @RATE@(at, input, k4);
        for (i = 0; i < @N@; i++)
            x[i] = x[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
    }
}

";

const START_AT: &str = "/* In the place of observer_start at a machine that rests at its measurements under a held command: the estimate is that state of
   rest, and what else holds it is the disturbance. With the set point where the machine rests, observer_step then
   begins with that command. 1, or 0 and as observer_start where a number is none, or no state of rest is found. */
int observer_start_at(observer_memory *memory, const double measured[@M@], double command)
{
    const double gap = @GAP@;
    const double held = command > gap ? command - gap : command < -gap ? command + gap : 0.0;
    int i;
    observer_start(memory);
    if (command - command != 0.0) return 0;
    for (i = 0; i < @M@; i++) {
        if (measured[i] - measured[i] != 0.0) return 0;
    }
@BALANCE@    for (i = 0; i < @PAST@; i++) memory->past[i] = held;
    memory->command = command;
    memory->started = 1;
@OFFSET@    return 1;
}

";

const BALANCE: &str = "    {
        static const int place[@M@] = {@PLACES@};
        static const double point[@N1@] = @POINT@, size[@N1@] = @SIZES@;
        static const double toward[@N1@][@NM@] = {@MATRIX@};
        double x[@N1@], off[@NM@], change[@N1@], input[1], length, last = -1.0;
        int j, k;
        for (i = 0; i < @N1@; i++) x[i] = point[i];
        x[@N@] -= held;
        for (k = 0; k < @STEPS@; k++) {
            input[0] = held + x[@N@];
            @RATE@(x, input, off);
            for (j = 0; j < @M@; j++) off[@N@ + j] = x[place[j]] - measured[j];
            length = 0.0;
            for (i = 0; i < @N1@; i++) {
                change[i] = 0.0;
                for (j = 0; j < @NM@; j++) change[i] += toward[i][j] * off[j];
                length += change[i] / size[i] * (change[i] / size[i]);
            }
            if (length - length != 0.0 || (last >= 0.0 && length >= last)) break;
            for (i = 0; i < @N1@; i++) x[i] -= change[i];
            last = length;
            if (length <= @LAST@ * @LAST@) break;
        }
        if (last < 0.0 || last > @CLOSE@ * @CLOSE@) return 0;
        for (i = 0; i < @N1@; i++) memory->estimate[i] = x[i];
    }
";

const CHAIN_AT_REST: &str =
    "    memory->chain[@START@] = memory->estimate[@FIRST@] = memory->last[@K@] = measured[@AT@];
    memory->chain[@LAST@] = @AGAINST@ * held;
    memory->begun[@K@] = 1;
";

const EXPLAINED: &str = "    explain(memory, held);
";

const OFFSET: &str = "    memory->offset = memory->estimate[@N@];
";

const STEP: &str = "/* Once a sample, every @DT@ s: the command from the measurements and the set point. A measurement that is not a
   number is left out. */
double observer_step(observer_memory *memory, const double measured[@M@], const double set_point[@R@])
{
    static const int place[@M@] = {@PLACES@};
    double *x = memory->estimate, *past = memory->past;
    const double u = memory->command;
    const double gap = @GAP@;
    double out[1];
    int i;
    for (i = @OLDEST@; i > 0; i--) past[i] = past[i - 1];
    past[0] = u > gap ? u - gap : u < -gap ? u + gap : 0.0;
    if (!memory->started) {
        for (i = 0; i < @M@; i++)
            x[place[i]] = measured[i] - measured[i] == 0.0 ? measured[i] : 0.0;
    }@ESTIMATE@    memory->started = 1;
@LAW@    memory->command = out[0];
    return out[0];
}
";

const KALMAN: &str = " else {
        static const double gain[@N1@][@M@] = {@GAIN@};
        double innovation[@M@];
        int j;
@PREDICTIONS@        for (i = 0; i < @M@; i++)
            innovation[i] = measured[i] - measured[i] == 0.0 ? measured[i] - x[place[i]] : 0.0;
        for (i = 0; i < @N1@; i++)
            for (j = 0; j < @M@; j++) x[i] += gain[i][j] * innovation[j];
    }
";

const EXPLAIN: &str = "/* The disturbance: what the equations do not explain of the highest derivatives. */
static void explain(observer_memory *memory, double acting)
{
    double *x = memory->estimate;
    double lumped, above = 0.0, below = 0.0, rest[@N@], moved[@N@], input[1];
    input[0] = acting;
    @RATE@(x, input, rest);
    input[0] = acting + 1.0;
    @RATE@(x, input, moved);
@DISTURBANCES@    x[@N@] = below > 0.0 ? above / below : 0.0;
}

";

const ESO: &str = "
    {
        const double acting = @ACTING@;
@CHAINS@        explain(memory, acting);
    }
";

const CHAIN: &str = "        {
            static const double a[@SIZE@][@SIZE@] = {@A@};
            static const double before[@SIZE@] = @BEFORE@, now[@SIZE@] = @NOW@, g[@SIZE@] = @INPUT@;
            double *z = memory->chain + @START@;
            double next[@SIZE@], y = measured[@AT@];
            const int known = y - y == 0.0;
            int j;
            if (memory->begun[@K@]) {
                for (i = 0; i < @SIZE@; i++) {
                    next[i] = before[i] * memory->last[@K@] + g[i] * acting;
                    for (j = 0; j < @SIZE@; j++) next[i] += a[i][j] * z[j];
                }
                /* Without a measurement, the one that is expected. */
                if (!known) y = next[0] / (1.0 - now[0]);
                for (i = 0; i < @SIZE@; i++) z[i] = next[i] + now[i] * y;
                memory->last[@K@] = y;
            } else if (known) {
                z[0] = y;
                memory->last[@K@] = y;
                memory->begun[@K@] = 1;
            }
            for (i = 0; i < @ORDER@; i++) x[@FIRST@ + i] = z[i];
        }
";

const DISTURBANCE: &str = "    lumped = memory->chain[@LAST@] + @GAIN@ * acting;
    above += @WEIGHT@ * (moved[@ROW@] - rest[@ROW@]) * (lumped - rest[@ROW@]);
    below += @WEIGHT@ * (moved[@ROW@] - rest[@ROW@]) * (moved[@ROW@] - rest[@ROW@]);
";

const AHEAD: &str = "    /* The law acts on the states that its command will meet. */
    {
        double ahead[@N1@];
        for (i = 0; i < @N1@; i++) ahead[i] = x[i];
@PREDICTIONS@@CALL@    }
";

const RESTING: &str = "    double offset; /* the integral action at rest */
    double reading, reference, held[@N@];
    int stayed, holds;
";

const UNMOVED: &str = "    memory->offset = memory->reading = memory->reference = 0.0;
    for (i = 0; i < @N@; i++) memory->held[i] = 0.0;
    memory->stayed = -1;
    memory->holds = 0;
";

const SLOW: &str = " || (@X@[@RATE@] < @VELOCITY@ && @X@[@RATE@] > -@VELOCITY@)";

const REST: &str = "    /* At rest the law is given the reading, and of the other states the estimate as it was; the offset moves while the
       reading stays. */
    {
        const double step = @STEP@, y = measured[@AT@], r = set_point[0];
        const double moved = y - memory->reading, error = r - y;
        const int is_new = memory->stayed < 0 || memory->reference != r;
        double *held = memory->held, change;
        int stays;
        memory->reference = r;
        if (is_new || !(moved <= 0.5 * step && moved >= -0.5 * step)) {
            memory->reading = y;
            memory->stayed = 0;
        } else if (memory->stayed < @SAMPLES@) {
            memory->stayed++;
        }
        stays = memory->stayed == @SAMPLES@;
        if (is_new || y - y != 0.0 || !(stays@SLOW@)) {
            memory->holds = 0;
            @LAW@(@X@, &memory->offset, set_point, out);
        } else {
            if (!memory->holds) {
                for (i = 0; i < @N@; i++) held[i] = @X@[i];
            }
            memory->holds = 1;
            held[@TRACKED@] = y;
            @LAW@(held, &memory->offset, set_point, out);
            if (stays && (error > step || error < -step)) {
                change = out[0];
                held[@TRACKED@] = error > 0.0 ? r - step : r + step;
                @LAW@(held, &memory->offset, set_point, out);
                change -= out[0];
                held[@TRACKED@] = y;
                if (change - change == 0.0) memory->offset -= change * @DT@ / @TIME@;
                @LAW@(held, &memory->offset, set_point, out);
            }
        }
    }
";

/// What follows the machine's equations in the observer's file.
pub(super) fn write(code: &ObserverCode) -> String {
    let (n, m, delay) = (code.states(), code.measured.len(), code.input_delay.0);
    let (n1, past, (law, rate)) = (n + 1, delay + 2, (&code.law.name, &code.rate.name));
    let r = code.references();
    let (k, size) = (code.chains().len(), code.chains().iter().map(|c| c.a.len()).sum::<usize>());
    let chained = |text: &str| match k {
        0 => String::new(),
        k => fill(text, &[("SIZE", &size), ("K", &k)]),
    };
    let resting = |text: &str| code.rest.as_ref().map_or_else(String::new, |_| fill(text, &[("N", &n)]));
    let mut out: String =
        code.summary.iter().map(|l| format!("/* {} */\n", crate::language::comment(l))).collect();
    out.push_str(&fill(
        MEMORY,
        &[
            ("LAW", law),
            ("N", &n),
            ("N1", &n1),
            ("M", &m),
            ("R", &r),
            ("PAST", &past),
            ("CHAINS", &chained(CHAINS)),
            ("START", &chained(START)),
            ("REST", &resting(RESTING)),
            ("UNMOVED", &resting(UNMOVED)),
        ],
    ));
    if code.predicts() {
        out.push_str(&fill(PREDICT, &[("N", &n), ("N1", &n1), ("RATE", rate)]));
    }
    let text = ChainText {
        explain: EXPLAIN,
        whole: ESO,
        rest: CHAIN_AT_REST,
        chain: CHAIN,
        disturbance: DISTURBANCE,
        row: braces,
        past: "past",
    };
    let (estimate, balance) = match &code.form {
        ObserverForm::Kalman { gain, start } => {
            let estimate = fill(
                KALMAN,
                &[
                    ("N1", &n1),
                    ("M", &m),
                    ("GAIN", &list(gain.iter().map(|row| braces(row)))),
                    ("PREDICTIONS", &code.over_a_sample(&predict("x"))),
                ],
            );
            (estimate, start.write(BALANCE, braces, code))
        }
        ObserverForm::Chains(chains) => {
            out.push_str(&text.explained(code, chains));
            (text.write(code, chains), text.at_rest(code, chains) + EXPLAINED)
        }
    };
    let offset = code.rest.as_ref().map_or_else(String::new, |_| fill(OFFSET, &[("N", &n)]));
    out.push_str(&fill(
        START_AT,
        &[
            ("M", &m),
            ("GAP", &number(code.dead_zone)),
            ("PAST", &past),
            ("BALANCE", &balance),
            ("OFFSET", &offset),
        ],
    ));
    let call = if code.is_delayed() {
        let predictions = code.over_the_delay(&predict("ahead"), "i - 1", &|call| {
            format!("        for (i = {delay}; i > 0; i--) {}", call.trim_start())
        });
        let call: String = command(code, "ahead").lines().map(|line| format!("    {line}\n")).collect();
        fill(AHEAD, &[("N1", &n1), ("PREDICTIONS", &predictions), ("CALL", &call)])
    } else {
        command(code, "x")
    };
    out.push_str(&fill(
        STEP,
        &[
            ("DT", &number(code.dt)),
            ("M", &m),
            ("R", &r),
            ("PLACES", &list(code.measured.iter().map(usize::to_string))),
            ("GAP", &number(code.dead_zone)),
            ("OLDEST", &(delay + 1)),
            ("ESTIMATE", &estimate),
            ("LAW", &call),
        ],
    ));
    out
}

/// The command of the estimate `x`.
fn command(code: &ObserverCode, x: &str) -> String {
    match &code.rest {
        Some(rest) => rest.write(REST, SLOW, x, code),
        None => format!("    {}({x}, {x} + {}, set_point, out);\n", code.law.name, code.states()),
    }
}

/// A call that predicts `x` over a time under a command of the past.
fn predict(x: &str) -> impl Fn(&str, (f64, usize)) -> String {
    move |past, (time, steps)| format!("        predict({x}, past[{past}], {}, {steps});\n", number(time))
}

fn braces(row: &[f64]) -> String {
    format!("{{{}}}", list(row.iter().map(|v| number(*v))))
}
