/* A machine of jaxvib as a functional mock-up unit of FMI 2.0, model exchange and co-simulation. */

#include "machine.h"

#if defined _WIN32 || defined __CYGWIN__
#define EXPORT __declspec(dllexport)
#elif __GNUC__ >= 4
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif
#define PASTE2(a, b) a##b
#define PASTE(a, b) PASTE2(a, b)
#ifdef FMI2_FUNCTION_PREFIX
#define FMI(name) PASTE(FMI2_FUNCTION_PREFIX, fmi2##name)
#else
#define FMI(name) fmi2##name
#endif

typedef enum { Ok, Warning, Discard, Error, Fatal, Pending } Status;
typedef void (*Logger)(void *environment, const char *name, Status status, const char *category, const char *message, ...);
typedef struct {
    Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, Status);
    void *environment;
} Callbacks;
typedef struct {
    int new_discrete_states, terminate, nominals_changed, states_changed, next_time_defined;
    double next_time;
} EventInfo;

static void log_text(Machine *m, const char *text) {
    Logger logger = *(Logger *)&m->logger;
    if (logger) logger(m->environment, m->name, Error, "logStatusError", "%s", text);
}

static Status judged(int done) { return done ? Ok : Error; }

EXPORT const char *FMI(GetTypesPlatform)(void) { return "default"; }
EXPORT const char *FMI(GetVersion)(void) { return "2.0"; }
EXPORT Status FMI(SetDebugLogging)(void *m, int on, size_t n, const char *const categories[]) { return Ok; }

EXPORT void *FMI(Instantiate)(const char *name, int type, const char *token, const char *resources, const Callbacks *callbacks,
                              int visible, int logging) {
    return create(name, token, log_text, callbacks ? callbacks->environment : NULL,
                  callbacks ? *(void **)&callbacks->logger : NULL);
}
EXPORT void FMI(FreeInstance)(void *m) { destroy(m); }

EXPORT Status FMI(SetupExperiment)(void *m, int has_tolerance, double tolerance, double start, int has_stop, double stop) {
    set_time(m, start);
    return Ok;
}
EXPORT Status FMI(EnterInitializationMode)(void *m) { return Ok; }
EXPORT Status FMI(ExitInitializationMode)(void *m) { return judged(update(m)); }
EXPORT Status FMI(Terminate)(void *m) { return Ok; }
EXPORT Status FMI(Reset)(void *m) {
    reset(m);
    return Ok;
}

EXPORT Status FMI(GetReal)(void *m, const unsigned reference[], size_t n, double value[]) {
    return judged(get_values(m, reference, n, value));
}
EXPORT Status FMI(SetReal)(void *m, const unsigned reference[], size_t n, const double value[]) {
    return judged(set_values(m, reference, n, value));
}

/* All variables are real numbers. */
#define NONE_OF(Kind, Type)                                                                                   \
    EXPORT Status FMI(Get##Kind)(void *m, const unsigned reference[], size_t n, Type value[]) { return judged(!n); } \
    EXPORT Status FMI(Set##Kind)(void *m, const unsigned reference[], size_t n, const Type value[]) { return judged(!n); }
NONE_OF(Integer, int)
NONE_OF(Boolean, int)
typedef const char *Text;
NONE_OF(String, Text)

EXPORT Status FMI(GetFMUstate)(Machine *m, void **state) {
    if (!*state) *state = malloc(sizeof m->data);
    if (!*state) return Error;
    memcpy(*state, &m->data, sizeof m->data);
    return Ok;
}
EXPORT Status FMI(SetFMUstate)(Machine *m, void *state) {
    if (!state) return Error;
    memcpy(&m->data, state, sizeof m->data);
    return Ok;
}
EXPORT Status FMI(FreeFMUstate)(void *m, void **state) {
    if (state) free(*state), *state = NULL;
    return Ok;
}
EXPORT Status FMI(SerializedFMUstateSize)(void *m, void *state, size_t *size) {
    *size = sizeof(Data);
    return Ok;
}
EXPORT Status FMI(SerializeFMUstate)(void *m, void *state, char bytes[], size_t size) {
    if (!state || size < sizeof(Data)) return Error;
    memcpy(bytes, state, sizeof(Data));
    return Ok;
}
EXPORT Status FMI(DeSerializeFMUstate)(void *m, const char bytes[], size_t size, void **state) {
    if (size != sizeof(Data)) return Error;
    if (!*state) *state = malloc(sizeof(Data));
    if (!*state) return Error;
    memcpy(*state, bytes, sizeof(Data));
    return Ok;
}

EXPORT Status FMI(GetDirectionalDerivative)(void *m, const unsigned unknown[], size_t unknowns, const unsigned known[],
                                            size_t knowns, const double seed[], double sensitivity[]) {
    return judged(differentiate_values(m, unknown, unknowns, known, knowns, seed, sensitivity));
}

EXPORT Status FMI(EnterEventMode)(void *m) { return Ok; }
EXPORT Status FMI(NewDiscreteStates)(void *m, EventInfo *info) {
    EventInfo nothing = {0, 0, 0, 0, 0, 0.0};
    *info = nothing;
    return judged(update(m));
}
EXPORT Status FMI(EnterContinuousTimeMode)(void *m) { return judged(update(m)); }
EXPORT Status FMI(CompletedIntegratorStep)(void *m, int no_return, int *enter_event_mode, int *terminate) {
    *enter_event_mode = *terminate = 0;
    return Ok;
}
EXPORT Status FMI(SetTime)(void *m, double time) {
    set_time(m, time);
    return Ok;
}
EXPORT Status FMI(SetContinuousStates)(void *m, const double states[], size_t n) {
    if (n != STATES) return Error;
    set_states(m, states);
    return Ok;
}
EXPORT Status FMI(GetDerivatives)(Machine *m, double rates[], size_t n) {
    if (n != STATES) return Error;
    if (!update(m)) return Discard;
    memcpy(rates, m->data.values + AT_RATES, n * sizeof(double));
    return Ok;
}
EXPORT Status FMI(GetEventIndicators)(Machine *m, double indicators[], size_t n) {
    if (n != INDICATORS) return Error;
    if (!update(m)) return Discard;
    memcpy(indicators, m->data.values + AT_INDICATORS, n * sizeof(double));
    return Ok;
}
EXPORT Status FMI(GetContinuousStates)(Machine *m, double states[], size_t n) {
    if (n != STATES) return Error;
    memcpy(states, m->data.values + AT_STATES, n * sizeof(double));
    return Ok;
}
EXPORT Status FMI(GetNominalsOfContinuousStates)(void *m, double nominals[], size_t n) {
    if (n != STATES) return Error;
    memcpy(nominals, NOMINALS, n * sizeof(double));
    return Ok;
}

EXPORT Status FMI(DoStep)(void *m, double time, double length, int no_return) { return judged(advance(m, time, length)); }
EXPORT Status FMI(CancelStep)(void *m) { return Error; }
EXPORT Status FMI(SetRealInputDerivatives)(void *m, const unsigned r[], size_t n, const int order[], const double value[]) {
    return judged(!n);
}
EXPORT Status FMI(GetRealOutputDerivatives)(void *m, const unsigned r[], size_t n, const int order[], double value[]) {
    return judged(!n);
}
EXPORT Status FMI(GetStatus)(void *m, int kind, Status *value) { return Discard; }
EXPORT Status FMI(GetRealStatus)(Machine *m, int kind, double *value) {
    if (kind != 2) return Discard;
    *value = m->data.values[0];
    return Ok;
}
EXPORT Status FMI(GetIntegerStatus)(void *m, int kind, int *value) { return Discard; }
EXPORT Status FMI(GetBooleanStatus)(void *m, int kind, int *value) {
    *value = 0;
    return kind == 3 ? Ok : Discard;
}
EXPORT Status FMI(GetStringStatus)(void *m, int kind, const char **value) { return Discard; }
