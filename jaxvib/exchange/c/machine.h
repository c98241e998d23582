/* A machine of jaxvib: one instance, its values and its steps.

   "model.h" contains the equations of one scene. The values of an instance are in one array, in the order of their value
   references: time, states, their rates, inputs, outputs, parameters (the last one is the step of co-simulation), event
   indicators. */

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define AT_STATES 1
#define AT_RATES (AT_STATES + STATES)
#define AT_INPUTS (AT_RATES + STATES)
#define AT_OUTPUTS (AT_INPUTS + INPUTS)
#define AT_PARAMETERS (AT_OUTPUTS + OUTPUTS)
#define AT_INDICATORS (AT_PARAMETERS + PARAMETERS)
#define VALUES (AT_INDICATORS + INDICATORS)
#define AT_STEP (AT_INDICATORS - 1)
#define MOST_STEPS 1e9

/* All data that change during a simulation: a copy of them is a saved state of the instance. */
typedef struct {
    double values[VALUES];
    double constants[CONSTANTS + 1];
    int prepared, evaluated;
} Data;

typedef struct Machine Machine;
struct Machine {
    Data data;
    char *name;
    void *environment, *logger;
    void (*log)(Machine *machine, const char *text);
};

static int report(Machine *m, const char *format, ...) {
    char text[512];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    if (m->log) m->log(m, text);
    return 0;
}

static void reset(Machine *m) {
    memset(&m->data, 0, sizeof m->data);
    memcpy(m->data.values + AT_STATES, START_STATES, STATES * sizeof(double));
    memcpy(m->data.values + AT_INPUTS, START_INPUTS, INPUTS * sizeof(double));
    memcpy(m->data.values + AT_PARAMETERS, START_PARAMETERS, PARAMETERS * sizeof(double));
}

static Machine *create(const char *name, const char *token, void (*log)(Machine *, const char *), void *environment,
                       void *logger) {
    Machine *m = calloc(1, sizeof *m);
    if (!m) return NULL;
    m->log = log;
    m->environment = environment;
    m->logger = logger;
    m->name = calloc(strlen(name ? name : "") + 1, 1);
    if (m->name) strcpy(m->name, name ? name : "");
    if (!m->name || !token || strcmp(token, TOKEN)) {
        report(m, "the token of the model description differs from that of the binary; both must be from the same FMU");
        free(m->name);
        free(m);
        return NULL;
    }
    reset(m);
    return m;
}

static void destroy(Machine *m) {
    if (m) free(m->name);
    free(m);
}

/* Compute the rates, outputs and event indicators of the present values. */
static void compute(Machine *m) {
    Data *d = &m->data;
    double *v = d->values;
    if (!d->prepared) prepare(v + AT_PARAMETERS, d->constants);
    d->prepared = 1;
    evaluate(v + AT_PARAMETERS, d->constants, v[0], v + AT_STATES, v + AT_INPUTS, v + AT_RATES, v + AT_OUTPUTS,
             v + AT_INDICATORS);
}

/* Compute rates, outputs and indicators if a value has changed; return 0 if a state, rate, input or output is not finite. */
static int update(Machine *m) {
    double *v = m->data.values;
    if (m->data.evaluated) return 1;
    compute(m);
    for (int i = AT_STATES; i < AT_PARAMETERS; i++)
        if (!isfinite(v[i])) return report(m, "%s is not finite at %g s", NAMES[i], v[0]);
    m->data.evaluated = 1;
    return 1;
}

static int get_values(Machine *m, const unsigned *reference, size_t n, double *value) {
    for (size_t i = 0; i < n; i++) {
        if (reference[i] >= VALUES) return report(m, "the value reference %u does not exist", reference[i]);
        int computed = (reference[i] >= AT_RATES && reference[i] < AT_INPUTS) ||
                       (reference[i] >= AT_OUTPUTS && reference[i] < AT_PARAMETERS) || reference[i] >= AT_INDICATORS;
        if (computed && !update(m)) return 0;
        value[i] = m->data.values[reference[i]];
    }
    return 1;
}

static int set_values(Machine *m, const unsigned *reference, size_t n, const double *value) {
    for (size_t i = 0; i < n; i++) {
        unsigned r = reference[i];
        int is_parameter = r >= AT_PARAMETERS && r < AT_INDICATORS;
        if (!((r >= AT_STATES && r < AT_RATES) || (r >= AT_INPUTS && r < AT_OUTPUTS) || is_parameter))
            return report(m, "the value of %s cannot be set", r < VALUES ? NAMES[r] : "a reference that does not exist");
        if (!isfinite(value[i])) return report(m, "%s is not finite; give a number", NAMES[r]);
        if (is_parameter) {
            int k = (int)(r - AT_PARAMETERS);
            int below = OPEN[k] & 1 ? value[i] <= LOW[k] : value[i] < LOW[k];
            int above = OPEN[k] & 2 ? value[i] >= HIGH[k] : value[i] > HIGH[k];
            if (below)
                return report(m, "%s is %g; it must be %s %g", NAMES[r], value[i], OPEN[k] & 1 ? "greater than" : "at least",
                              LOW[k]);
            if (above)
                return report(m, "%s is %g; it must be %s %g", NAMES[r], value[i], OPEN[k] & 2 ? "less than" : "at most",
                              HIGH[k]);
            m->data.prepared = 0;
        }
        m->data.values[r] = value[i];
    }
    m->data.evaluated = 0;
    return 1;
}

static void set_time(Machine *m, double time) {
    m->data.values[0] = time;
    m->data.evaluated = 0;
}

static void set_states(Machine *m, const double *states) {
    memcpy(m->data.values + AT_STATES, states, STATES * sizeof(double));
    m->data.evaluated = 0;
}

/* Compute the derivatives of rates and outputs in a direction of states, inputs, parameters and time. */
static int differentiate_values(Machine *m, const unsigned *unknown, size_t unknowns, const unsigned *known, size_t knowns,
                                const double *seed, double *sensitivity) {
    double direction[VALUES] = {0}, change[VALUES] = {0}, constants[TANGENT_CONSTANTS + 1], *v = m->data.values;
    double full_constants[FULL_TANGENT_CONSTANTS + 1], *x = direction + AT_STATES, *u = direction + AT_INPUTS;
    int full = 0;
    for (size_t i = 0; i < knowns; i++) {
        unsigned r = known[i];
        int is_fixed = !r || (r >= AT_PARAMETERS && r < AT_INDICATORS);
        if (!(is_fixed || (r >= AT_STATES && r < AT_RATES) || (r >= AT_INPUTS && r < AT_OUTPUTS)))
            return report(m, "there is no derivative with respect to %s, only to states, inputs, parameters and time",
                          r < VALUES ? NAMES[r] : "this");
        direction[r] = change[r] = seed[i];
        full |= is_fixed;
    }
    if (full) {
        prepare_full_tangent(v + AT_PARAMETERS, full_constants);
        full_tangent(v + AT_PARAMETERS, full_constants, v[0], v + AT_STATES, v + AT_INPUTS, direction + AT_PARAMETERS,
                     direction[0], x, u, change + AT_RATES, change + AT_OUTPUTS);
    } else {
        prepare_tangent(v + AT_PARAMETERS, constants);
        tangent(v + AT_PARAMETERS, constants, v[0], v + AT_STATES, v + AT_INPUTS, x, u, change + AT_RATES,
                change + AT_OUTPUTS);
    }
    for (size_t i = 0; i < unknowns; i++) {
        unsigned r = unknown[i];
        if (!(r >= AT_STATES && r < AT_PARAMETERS))
            return report(m, "there is no derivative of %s, only of states, rates and outputs", r < VALUES ? NAMES[r] : "this");
        if (!isfinite(change[r])) return report(m, "the derivative of %s is not finite at %g s", NAMES[r], v[0]);
        sensitivity[i] = change[r];
    }
    return 1;
}

/* Advance by `length` in equal Runge-Kutta steps of order 4, which are not longer than the parameter co_simulation.step. */
static int advance(Machine *m, double time, double length) {
    static const double share[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0, 2.0, 2.0, 1.0};
    double *x = m->data.values + AT_STATES, *rate = m->data.values + AT_RATES, begin[STATES + 1], sum[STATES + 1];
    double most = m->data.values[AT_STEP];
    if (!(length >= 0.0) || !isfinite(time) || length / most > MOST_STEPS)
        return report(m, "a step of %g s from the time %g s is not possible with a co_simulation.step of %g s", length, time, most);
    double steps = ceil(length / most * (1.0 - 1e-12));
    double h = steps > 0.0 ? length / steps : 0.0;
    for (double n = 0.0; n < steps; n += 1.0) {
        memcpy(begin, x, STATES * sizeof(double));
        memset(sum, 0, sizeof sum);
        for (int stage = 0; stage < 4; stage++) {
            for (int i = 0; i < STATES; i++) x[i] = begin[i] + (stage ? share[stage] * h * rate[i] : 0.0);
            m->data.values[0] = time + (n + share[stage]) * h;
            compute(m);
            for (int i = 0; i < STATES; i++) sum[i] += weight[stage] * rate[i];
        }
        for (int i = 0; i < STATES; i++) x[i] = begin[i] + h / 6.0 * sum[i];
        for (int i = 0; i < STATES; i++)
            if (!isfinite(x[i])) return report(m, "%s is not finite after %g s", NAMES[AT_STATES + i], time + (n + 1.0) * h);
    }
    set_time(m, time + length);
    return update(m);
}
