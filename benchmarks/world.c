/* One elastic joint with the effects that real joints have and joint files do not name.

   cc -O2 -o world benchmarks/world.c -lm && ./world friction=lugre gear_loss=0.04 motion=pushes > joint.csv

   Independent of sim/ and of the estimator: own equations, own integrator (Runge-Kutta 4, 20 steps a period).
       B θ" = τ + τ_e - D θ' - F - cogging        M q" = -τ_e - Dq q' - g sin q + τ_k        φ = q - θ
   τ_e is what the transmission carries: spring after backlash, hysteresis and damping. Torque is held for a
   period. Angles in rad on the joint side, torques in N·m, SI otherwise. The recording goes to standard output,
   in the columns of a recording and four columns of truth. `./world help` lists every setting. */

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { SUBSTEPS = 20, SINES = 7, STATES = 6, LONGEST_DELAY = 1000 };
static const double PI = 3.14159265358979323846;

enum spring { LINEAR, CUBIC, EXPONENTIAL, VSA_II };
enum friction { NO_FRICTION, COULOMB, STRIBECK, LUGRE };
enum memory { NO_MEMORY, DAHL, BOUC_WEN };
enum motion { MULTISINE, POINT_TO_POINT, HAND_GUIDED, PUSHES, HARMONIC, PLAYED };

static double spring, stiffness = 150, cubic = 5000, exponent = 6, linkage = 1.75, inertia = 0.12, damping = 0.8;
static double link_inertia = 0.45, link_damping = 0.5, gravity = 3;
static double friction, coulomb = 0.3, stribeck = 0.5, stribeck_velocity = 0.05, bristle = 2e-3, bristle_damping = 0.3;
static double gear_loss, hysteresis, hysteresis_torque = 0.3, hysteresis_width = 4e-3, backlash, rounding = 0.25;
static double transmission_damping, cogging, cogging_periods = 32, link_delay, motor_counts = 8192, link_bits = 17, eccentricity;
static double torque_delay, torque_lag, torque_noise, motion, size = 7, top_hz = 3, push = 5, pull, seconds = 30, period = 1e-3, seed = 1;

static const struct setting {
    const char *name;
    double *value;
    const char *words, *meaning;
} SETTINGS[] = {
    {"spring", &spring, "linear cubic exponential vsa-ii", "f(φ)"},
    {"stiffness", &stiffness, 0, "K, N·m/rad at φ = 0; k of the VSA-II"},
    {"cubic", &cubic, 0, "K3 of K φ + K3 φ³, N·m/rad³"},
    {"exponent", &exponent, 0, "b of K/b (exp(b|φ|) - 1), 1/rad"},
    {"linkage", &linkage, 0, "C of the VSA-II: 2 k β β', β = asin(C sin(φ/2)) - φ/2"},
    {"inertia", &inertia, 0, "B of the motor, kg·m²"},
    {"damping", &damping, 0, "D of the motor, N·m·s/rad"},
    {"link_inertia", &link_inertia, 0, "M, kg·m²"},
    {"link_damping", &link_damping, 0, "Dq, N·m·s/rad"},
    {"gravity", &gravity, 0, "g of g sin q, N·m"},
    {"friction", &friction, "none coulomb stribeck lugre", "of the motor"},
    {"coulomb", &coulomb, 0, "sliding friction, N·m"},
    {"stribeck", &stribeck, 0, "(breakaway - sliding) / sliding friction"},
    {"stribeck_velocity", &stribeck_velocity, 0, "where that has fallen to 1/e, rad/s"},
    {"bristle", &bristle, 0, "LuGre: deflection of the bristles when sliding, rad"},
    {"bristle_damping", &bristle_damping, 0, "LuGre: σ1, N·m·s/rad"},
    {"gear_loss", &gear_loss, 0, "friction per N·m that the transmission carries"},
    {"hysteresis", &hysteresis, "none dahl bouc-wen", "of the transmission"},
    {"hysteresis_torque", &hysteresis_torque, 0, "its amplitude, N·m"},
    {"hysteresis_width", &hysteresis_width, 0, "deflection in which it turns round, rad"},
    {"backlash", &backlash, 0, "half the gap, rad"},
    {"rounding", &rounding, 0, "softness of its edges, in half gaps"},
    {"transmission_damping", &transmission_damping, 0, "N·m·s/rad, on φ'"},
    {"cogging", &cogging, 0, "amplitude, N·m"},
    {"cogging_periods", &cogging_periods, 0, "per turn of the joint"},
    {"link_delay", &link_delay, 0, "of the link encoder, s, in steps of period/20"},
    {"motor_counts", &motor_counts, 0, "per turn of the joint; 0: exact"},
    {"link_bits", &link_bits, 0, "2^bits per turn of the joint; 0: exact"},
    {"torque_delay", &torque_delay, 0, "of the reported torque, s: half a period where it is sampled and not held"},
    {"eccentricity", &eccentricity, 0, "of the link encoder, rad: it reads q + this sin q"},
    {"torque_lag", &torque_lag, 0, "of a drive's filter of the reported torque, s"},
    {"torque_noise", &torque_noise, 0, "standard deviation before it, N·m"},
    {"motion", &motion, "multisine point-to-point hand-guided pushes harmonic played", "what moves the joint"},
    {"size", &size, 0, "amplitude of the motor's torque, N·m; point-to-point: largest step, rad"},
    {"top_hz", &top_hz, 0, "fastest sine, or the harmonic one"},
    {"push", &push, 0, "amplitude of the torque on the link, N·m: hand-guided, pushes"},
    {"pull", &pull, 0, "constant torque on the link, N·m: a weight, or an opposing spring"},
    {"seconds", &seconds, 0, "length"},
    {"period", &period, 0, "s"},
    {"seed", &seed, 0, "of phases, targets, pushes and noise"},
};
enum { N_SETTINGS = sizeof SETTINGS / sizeof *SETTINGS };

static void help(void) {
    for (int i = 0; i < N_SETTINGS; i++) {
        const struct setting *s = &SETTINGS[i];
        printf("%-21s %-9g %s%s%s\n", s->name, *s->value, s->meaning, s->words ? ": " : "", s->words ? s->words : "");
    }
}

/* Number of a word in a list; -1: not in it. */
static int word(const char *words, const char *wanted) {
    char copy[128];
    int i = 0;
    strcpy(copy, words);
    for (char *w = strtok(copy, " "); w; w = strtok(0, " "), i++)
        if (!strcmp(w, wanted)) return i;
    return -1;
}

static void set(const char *argument) {
    const char *text = strchr(argument, '=');
    for (int i = 0; text && i < N_SETTINGS; i++) {
        const struct setting *s = &SETTINGS[i];
        char *end = 0;
        if (strlen(s->name) != (size_t)(text - argument) || strncmp(s->name, argument, strlen(s->name))) continue;
        *s->value = s->words ? word(s->words, text + 1) : strtod(text + 1, &end);
        if (s->words ? *s->value >= 0 : text[1] && !*end && isfinite(*s->value) && *s->value >= 0) return;
        fprintf(stderr, "%s: expected %s\n", argument, s->words ? s->words : "a number of at least 0");
        exit(2);
    }
    fprintf(stderr, "%s: expected NAME=VALUE; `help` lists the names\n", argument);
    exit(2);
}

/* Random numbers: splitmix64, Box-Muller. */
static uint64_t state;
static double uniform(double low, double high) {
    uint64_t z = state += 0x9E3779B97F4A7C15u;
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9u;
    z = (z ^ z >> 27) * 0x94D049BB133111EBu;
    return low + (high - low) * ((double)((z ^ z >> 31) >> 11) + 0.5) / 9007199254740992.0;
}
static double normal(void) { return sqrt(-2 * log(uniform(0, 1))) * cos(uniform(0, 2 * PI)); }

/* Deflection of the spring behind a gap with rounded edges, and its slope. */
static double behind_gap(double phi, double *slope) {
    double soft = rounding * backlash, up = phi + backlash, down = phi - backlash;
    *slope = 1;
    if (backlash == 0) return phi;
    double a = hypot(down, soft), b = hypot(up, soft);
    *slope = 1 + (down / a - up / b) / 2;
    return phi + (a - b) / 2;
}

static double spring_torque(double phi, double *slope) {
    double inner, x = behind_gap(phi, &inner), torque = stiffness * x, k = stiffness;
    if (spring == CUBIC) {
        torque += cubic * x * x * x;
        k += 3 * cubic * x * x;
    } else if (spring == EXPONENTIAL) {
        torque = copysign(stiffness / exponent * expm1(exponent * fabs(x)), x);
        k = stiffness * exp(exponent * fabs(x));
    } else if (spring == VSA_II) {
        double u = linkage * sin(x / 2), root = sqrt(1 - u * u), beta = asin(u) - x / 2;
        double c = linkage / 2 * cos(x / 2), turn = c / root - 0.5;
        torque = 2 * stiffness * beta * turn;
        k = 2 * stiffness * (turn * turn + beta * (u * c * c / pow(root, 3) - u / 4 / root));
    }
    *slope = k * inner;
    return torque;
}

/* x: θ, θ', q, q', LuGre's bristles (rad), hysteresis in -1 … 1. */
static double transmitted(const double *x, double *slope) {
    double torque = spring_torque(x[2] - x[0], slope);
    return torque + (hysteresis ? hysteresis_torque * x[5] : 0) + transmission_damping * (x[3] - x[1]);
}

/* Dry friction of the motor, sliding: its level. */
static double sliding(const double *x, double torque) {
    double peak = friction >= STRIBECK ? stribeck * coulomb * exp(-pow(x[1] / stribeck_velocity, 2)) : 0;
    return (friction ? coulomb : 0) + gear_loss * fabs(torque) + peak;
}

static void rate(const double *x, double motor, double external, double *dx) {
    double slope, torque = transmitted(x, &slope), w = x[1], phi_rate = x[3] - x[1], z = x[5];
    double level = sliding(x, torque), resisting = 0;
    dx[4] = 0;
    if (friction == LUGRE && level > 0) { /* the stiffness of the bristles is that of the sliding friction */
        double bristles = coulomb / bristle;
        dx[4] = w - bristles * fabs(w) * x[4] / level;
        resisting = bristles * x[4] + bristle_damping * dx[4];
    }
    dx[0] = w;
    dx[1] = (motor + torque - damping * w - resisting - cogging * sin(cogging_periods * x[0])) / inertia;
    dx[2] = x[3];
    dx[3] = (-torque - link_damping * x[3] - gravity * sin(x[2]) + external) / link_inertia;
    double sign = phi_rate * z > 0 ? 1 : phi_rate * z < 0 ? -1 : 0; /* Dahl; Bouc-Wen: β = 0.7, γ = 0.3, n = 1.5 */
    double turned = hysteresis == DAHL ? fabs(z) * sign : pow(fabs(z), 1.5) * (0.7 * sign + 0.3);
    dx[5] = hysteresis ? phi_rate / hysteresis_width * (1 - turned) : 0;
}

/* Friction without bristles takes the motor's momentum, all of it at most: then it sticks, and does not creep. */
static void rub(double *x, double h) {
    double slope, most = sliding(x, transmitted(x, &slope)) * h / inertia;
    double taken = friction == LUGRE ? 0 : fmin(fmax(x[1], -most), most);
    x[0] -= taken * h / 2;
    x[1] -= taken;
}

static void advance(double *x, double motor, double external, double h) {
    double k[4][STATES], y[STATES];
    for (int stage = 0; stage < 4; stage++) {
        double step = stage == 0 ? 0 : stage == 3 ? h : h / 2;
        for (int i = 0; i < STATES; i++) y[i] = x[i] + (stage ? step * k[stage - 1][i] : 0);
        rate(y, motor, external, k[stage]);
    }
    for (int i = 0; i < STATES; i++) x[i] += h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
    rub(x, h);
}

/* Sum of sines from `low` to `high` Hz with random phases, of rms amplitude/√2. */
struct sines {
    double hz[SINES], phase[SINES];
};
static void draw_sines(struct sines *s, double low, double high) {
    for (int i = 0; i < SINES; i++) {
        s->hz[i] = low * pow(high / low, (double)i / (SINES - 1)) * uniform(0.85, 1.15);
        s->phase[i] = uniform(0, 2 * PI);
    }
}
static double sum_sines(const struct sines *s, double t) {
    double sum = 0;
    for (int i = 0; i < SINES; i++) sum += sin(2 * PI * s->hz[i] * t + s->phase[i]);
    return sum / sqrt(SINES);
}

static struct sines driven, guided;
static double from, target, move_start, move_time, push_start, push_time, push_torque;

/* What the drive reports of the torque: between those of earlier periods. */
static double reported(double motor, long k) {
    static double earlier[LONGEST_DELAY];
    double late = torque_delay / period, whole = floor(late);
    earlier[k % LONGEST_DELAY] = motor;
    long from = k - (long)whole < 0 ? 0 : k - (long)whole, before = from > 0 ? from - 1 : 0;
    return earlier[from % LONGEST_DELAY] * (1 - late + whole) + earlier[before % LONGEST_DELAY] * (late - whole);
}

/* A drive's position loop along quintic moves with rests between. */
static double point_to_point(const double *x, double t) {
    if (t >= move_start + move_time + 0.4) {
        from = target, target = uniform(-size, size), move_start = t;
        move_time = 0.3 + 0.8 * sqrt(fabs(target - from) / (size + 1e-9)) * uniform(0.7, 1.3);
    }
    double s = (t - move_start) / move_time, kp = 4 * stiffness, kd = 2 * sqrt(kp * inertia);
    s = s < 0 || move_time == 0 ? 0 : s > 1 ? 1 : s;
    double wanted = from + (target - from) * s * s * s * (10 - 15 * s + 6 * s * s);
    double speed = move_time ? (target - from) * 30 * s * s * (1 - s) * (1 - s) / move_time : 0;
    return kp * (wanted - x[0]) + kd * (speed - x[1]) + gravity * sin(wanted);
}

/* A drive's position loop along what standard input says: position and velocity of each period. */
static double played(const double *x) {
    static double wanted, speed;
    double next[2];
    if (scanf("%lf%*[, ]%lf", &next[0], &next[1]) == 2) wanted = next[0], speed = next[1];
    else speed = 0;
    double kp = 4 * stiffness, kd = 2 * sqrt(kp * inertia);
    return kp * (wanted - x[0]) + kd * (speed - x[1]) + damping * speed + gravity * sin(wanted);
}

static double motor_torque(const double *x, double t) {
    if (motion == PLAYED) return played(x);
    if (motion == POINT_TO_POINT) return point_to_point(x, t);
    if (motion == HAND_GUIDED) return gravity * sin(x[0]) - 0.5 * damping * x[1]; /* gravity is compensated */
    if (motion == HARMONIC) return size * sin(2 * PI * top_hz * t);
    return size * sum_sines(&driven, t);
}

static double external_torque(double t) {
    if (motion == HAND_GUIDED) return pull + push * sum_sines(&guided, t);
    if (motion != PUSHES) return pull;
    if (t >= push_start + push_time) {
        push_start = t + uniform(0.5, 3), push_time = uniform(0.1, 0.4);
        push_torque = push * uniform(-1, 1);
    }
    return pull + (t < push_start ? 0 : push_torque * sin(PI * (t - push_start) / push_time));
}

static double read_encoder(double angle, double per_turn) {
    double step = 2 * PI / per_turn;
    return per_turn > 1 ? floor(angle / step) * step : angle;
}

int main(int count, char **arguments) {
    static double link[LONGEST_DELAY]; /* of the last sub-steps */
    if (count == 2 && !strcmp(arguments[1], "help")) return help(), 0;
    for (int i = 1; i < count; i++) set(arguments[i]);
    double h = period / SUBSTEPS, x[STATES] = {0}, shown = 0;
    long late = lround(link_delay / h), step = 0;
    if (!(h > 0) || !(inertia > 0) || !(link_inertia > 0) || late >= LONGEST_DELAY ||
        torque_delay > 50 * period)
        return fputs("period, inertia, link_inertia: above 0; delays: below 50 periods\n", stderr), 2;
    state = (uint64_t)seed * 0x2545F4914F6CDD1Du;
    draw_sines(&driven, 0.2, top_hz), draw_sines(&guided, 0.15, 1.5);
    puts("time_s,motor1_position_rad,motor1_torque_nm,link_position_rad,"
         "true_stiffness_nm_rad,true_flexibility_torque_nm,true_spring_torque_nm,true_external_torque_nm");
    for (long k = 0; k < lround(seconds / period); k++) {
        double t = k * period, motor = motor_torque(x, t), external = external_torque(t), slope;
        double torque = transmitted(x, &slope), spring_only = spring_torque(x[2] - x[0], &slope);
        if (!isfinite(torque)) return fprintf(stderr, "at %g s the joint diverges: check the settings\n", t), 1;
        link[step % LONGEST_DELAY] = x[2];
        double seen = link[(step >= late ? step - late : 0) % LONGEST_DELAY];
        double measured = reported(motor, k) + (torque_noise ? torque_noise * normal() : 0);
        shown += (torque_lag > 0 ? 1 - exp(-period / torque_lag) : 1) * (measured - shown);
        printf("%.6f,%.12g,%.12g,%.12g,%.12g,%.12g,%.12g,%.12g\n", t, read_encoder(x[0], motor_counts),
               shown, read_encoder(seen + eccentricity * sin(seen), link_bits ? exp2(link_bits) : 0), slope, torque, spring_only, external);
        for (int i = 0; i < SUBSTEPS; i++) {
            advance(x, motor, external_torque(t + i * h), h);
            step++;
            link[step % LONGEST_DELAY] = x[2];
        }
    }
    return 0;
}
