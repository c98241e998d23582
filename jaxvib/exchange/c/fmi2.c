/* A machine of jaxvib as a functional mock-up unit of FMI 2.0, model exchange and co-simulation. */

#include "machine.h"

#ifdef FMI2_FUNCTION_PREFIX
#define FMI(name) PASTE(FMI2_FUNCTION_PREFIX, PASTE(fmi2, name))
#else
#define FMI(name) PASTE(fmi2, name)
#endif

/* Names in FMI 2.0 of functions of "fmi.h". */
#define GetFMUState GetFMUstate
#define SetFMUState SetFMUstate
#define FreeFMUState FreeFMUstate
#define SerializedFMUStateSize SerializedFMUstateSize
#define SerializeFMUState SerializeFMUstate
#define DeserializeFMUState DeSerializeFMUstate
#define GetContinuousStateDerivatives GetDerivatives

typedef enum { Ok, Warning, Discard, Error, Fatal, Pending } Status;
typedef int Bool;
typedef char Byte;
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

#include "fmi.h"

static void log_text(Machine *m, const char *text) {
    Logger logger = *(Logger *)&m->logger;
    if (logger) logger(m->environment, m->name, Error, "logStatusError", "%s", text);
}

EXPORT const char *FMI(GetTypesPlatform)(void) { return "default"; }
EXPORT const char *FMI(GetVersion)(void) { return "2.0"; }

EXPORT void *FMI(Instantiate)(const char *name, int type, const char *token, const char *resources, const Callbacks *callbacks,
                              int visible, int logging) {
    return create(name, token, log_text, callbacks ? callbacks->environment : NULL,
                  callbacks ? *(void **)&callbacks->logger : NULL);
}

EXPORT Status FMI(SetupExperiment)(void *m, int has_tolerance, double tolerance, double start, int has_stop, double stop) {
    set_time(m, start);
    return Ok;
}
EXPORT Status FMI(EnterInitializationMode)(void *m) { return Ok; }

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

EXPORT Status FMI(GetDirectionalDerivative)(void *m, const unsigned unknown[], size_t unknowns, const unsigned known[],
                                            size_t knowns, const double seed[], double sensitivity[]) {
    return judged(differentiate_values(m, unknown, unknowns, known, knowns, seed, sensitivity));
}

EXPORT Status FMI(NewDiscreteStates)(void *m, EventInfo *info) {
    EventInfo nothing = {0, 0, 0, 0, 0, 0.0};
    *info = nothing;
    return judged(update(m));
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
