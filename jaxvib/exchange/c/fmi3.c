/* A machine of jaxvib as a functional mock-up unit of FMI 3.0, model exchange and co-simulation. */

#include <stdbool.h>
#include <stdint.h>

#include "machine.h"

#ifdef FMI3_FUNCTION_PREFIX
#define FMI(name) PASTE(FMI3_FUNCTION_PREFIX, PASTE(fmi3, name))
#else
#define FMI(name) PASTE(fmi3, name)
#endif

typedef enum { Ok, Warning, Discard, Error, Fatal } Status;
typedef uint32_t Reference;
typedef bool Bool;
typedef uint8_t Byte;
typedef void (*Logger)(void *environment, Status status, const char *category, const char *message);

#include "fmi.h"

static void log_text(Machine *m, const char *text) {
    Logger logger = *(Logger *)&m->logger;
    if (logger) logger(m->environment, Error, "logStatusError", text);
}

EXPORT const char *FMI(GetVersion)(void) { return "3.0"; }

EXPORT void *FMI(InstantiateModelExchange)(const char *name, const char *token, const char *resources, bool visible,
                                           bool logging, void *environment, Logger logger) {
    return create(name, token, log_text, environment, *(void **)&logger);
}
EXPORT void *FMI(InstantiateCoSimulation)(const char *name, const char *token, const char *resources, bool visible,
                                          bool logging, bool event_mode, bool early_return, const Reference required[],
                                          size_t n, void *environment, Logger logger, void *intermediate_update) {
    return create(name, token, log_text, environment, *(void **)&logger);
}
EXPORT void *FMI(InstantiateScheduledExecution)(const char *name, const char *token, const char *resources, bool visible,
                                                bool logging, void *environment, Logger logger, void *clock_update,
                                                void *lock, void *unlock) {
    return NULL;
}

EXPORT Status FMI(EnterInitializationMode)(void *m, bool has_tolerance, double tolerance, double start, bool has_stop,
                                           double stop) {
    set_time(m, start);
    return Ok;
}
EXPORT Status FMI(EnterConfigurationMode)(void *m) { return Ok; }
EXPORT Status FMI(ExitConfigurationMode)(void *m) { return Ok; }
EXPORT Status FMI(EnterStepMode)(void *m) { return Ok; }

EXPORT Status FMI(GetFloat64)(void *m, const Reference reference[], size_t n, double value[], size_t values) {
    return judged(n == values && get_values(m, reference, n, value));
}
EXPORT Status FMI(SetFloat64)(void *m, const Reference reference[], size_t n, const double value[], size_t values) {
    return judged(n == values && set_values(m, reference, n, value));
}

/* All variables are Float64. */
typedef const char *Text;
#define NONE_OF(Kind, Type)                                                                                             \
    EXPORT Status FMI(Get##Kind)(void *m, const Reference r[], size_t n, Type value[], size_t k) { return judged(!n); } \
    EXPORT Status FMI(Set##Kind)(void *m, const Reference r[], size_t n, const Type value[], size_t k) { return judged(!n); }
NONE_OF(Float32, float)
NONE_OF(Int8, int8_t)
NONE_OF(UInt8, uint8_t)
NONE_OF(Int16, int16_t)
NONE_OF(UInt16, uint16_t)
NONE_OF(Int32, int32_t)
NONE_OF(UInt32, uint32_t)
NONE_OF(Int64, int64_t)
NONE_OF(UInt64, uint64_t)
NONE_OF(Boolean, bool)
NONE_OF(String, Text)
EXPORT Status FMI(GetBinary)(void *m, const Reference r[], size_t n, size_t sizes[], void *v[], size_t k) { return judged(!n); }
EXPORT Status FMI(SetBinary)(void *m, const Reference r[], size_t n, const size_t sizes[], void *v[], size_t k) {
    return judged(!n);
}
#define NO_CLOCK(Name, First, Second) \
    EXPORT Status FMI(Name)(void *m, const Reference r[], size_t n, First, Second) { return judged(!n); }
EXPORT Status FMI(GetClock)(void *m, const Reference r[], size_t n, bool value[]) { return judged(!n); }
EXPORT Status FMI(SetClock)(void *m, const Reference r[], size_t n, const bool value[]) { return judged(!n); }
NO_CLOCK(GetIntervalDecimal, double intervals[], int qualifiers[])
EXPORT Status FMI(GetIntervalFraction)(void *m, const Reference r[], size_t n, uint64_t a[], uint64_t b[], int qualifiers[]) {
    return judged(!n);
}
EXPORT Status FMI(GetShiftDecimal)(void *m, const Reference r[], size_t n, double shifts[]) { return judged(!n); }
NO_CLOCK(GetShiftFraction, uint64_t counters[], uint64_t resolutions[])
EXPORT Status FMI(SetIntervalDecimal)(void *m, const Reference r[], size_t n, const double intervals[]) { return judged(!n); }
NO_CLOCK(SetIntervalFraction, const uint64_t counters[], const uint64_t resolutions[])
EXPORT Status FMI(SetShiftDecimal)(void *m, const Reference r[], size_t n, const double shifts[]) { return judged(!n); }
NO_CLOCK(SetShiftFraction, const uint64_t counters[], const uint64_t resolutions[])
EXPORT Status FMI(GetNumberOfVariableDependencies)(void *m, Reference r, size_t *n) { return Error; }
EXPORT Status FMI(GetVariableDependencies)(void *m, Reference r, size_t a[], Reference independents[], size_t b[], int kinds[],
                                           size_t n) {
    return Error;
}
EXPORT Status FMI(ActivateModelPartition)(void *m, Reference clock, double time) { return Error; }

EXPORT Status FMI(GetDirectionalDerivative)(void *m, const Reference unknown[], size_t unknowns, const Reference known[],
                                            size_t knowns, const double seed[], size_t seeds, double sensitivity[],
                                            size_t sensitivities) {
    if (seeds != knowns || sensitivities != unknowns) return Error;
    return judged(differentiate_values(m, unknown, unknowns, known, knowns, seed, sensitivity));
}
EXPORT Status FMI(GetAdjointDerivative)(void *m, const Reference unknown[], size_t unknowns, const Reference known[],
                                        size_t knowns, const double seed[], size_t seeds, double sensitivity[],
                                        size_t sensitivities) {
    return Error;
}

EXPORT Status FMI(EvaluateDiscreteStates)(void *m) { return Ok; }
EXPORT Status FMI(UpdateDiscreteStates)(void *m, bool *need_update, bool *terminate, bool *nominals_changed,
                                        bool *states_changed, bool *next_time_defined, double *next_time) {
    *need_update = *terminate = *nominals_changed = *states_changed = *next_time_defined = false;
    return judged(update(m));
}
EXPORT Status FMI(GetNumberOfEventIndicators)(void *m, size_t *n) {
    *n = INDICATORS;
    return Ok;
}
EXPORT Status FMI(GetNumberOfContinuousStates)(void *m, size_t *n) {
    *n = STATES;
    return Ok;
}

EXPORT Status FMI(GetOutputDerivatives)(void *m, const Reference r[], size_t n, const int32_t orders[], double value[],
                                        size_t values) {
    return judged(!n);
}
EXPORT Status FMI(DoStep)(Machine *m, double time, double length, bool no_return, bool *event_needed, bool *terminate,
                          bool *early_return, double *last_time) {
    *event_needed = *terminate = *early_return = false;
    int done = advance(m, time, length);
    *last_time = m->data.values[0];
    return judged(done);
}
