/* Functions of FMI that have the same form in versions 2.0 and 3.0.

   The file that includes this one defines FMI(name), the name of a function with its prefix, Status, Bool and Byte. */

#if defined _WIN32 || defined __CYGWIN__
#define EXPORT __declspec(dllexport)
#elif __GNUC__ >= 4
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif
#define PASTE2(a, b) a##b
#define PASTE(a, b) PASTE2(a, b)

static Status judged(int done) { return done ? Ok : Error; }

EXPORT Status FMI(SetDebugLogging)(void *m, Bool on, size_t n, const char *const categories[]) { return Ok; }
EXPORT void FMI(FreeInstance)(void *m) { destroy(m); }
EXPORT Status FMI(ExitInitializationMode)(void *m) { return judged(update(m)); }
EXPORT Status FMI(EnterEventMode)(void *m) { return Ok; }
EXPORT Status FMI(EnterContinuousTimeMode)(void *m) { return judged(update(m)); }
EXPORT Status FMI(Terminate)(void *m) { return Ok; }
EXPORT Status FMI(Reset)(void *m) {
    reset(m);
    return Ok;
}

EXPORT Status FMI(GetFMUState)(Machine *m, void **state) {
    if (!*state) *state = malloc(sizeof m->data);
    if (!*state) return Error;
    memcpy(*state, &m->data, sizeof m->data);
    return Ok;
}
EXPORT Status FMI(SetFMUState)(Machine *m, void *state) {
    if (!state) return Error;
    memcpy(&m->data, state, sizeof m->data);
    return Ok;
}
EXPORT Status FMI(FreeFMUState)(void *m, void **state) {
    if (state) free(*state), *state = NULL;
    return Ok;
}
EXPORT Status FMI(SerializedFMUStateSize)(void *m, void *state, size_t *size) {
    *size = sizeof(Data);
    return Ok;
}
EXPORT Status FMI(SerializeFMUState)(void *m, void *state, Byte bytes[], size_t size) {
    if (!state || size < sizeof(Data)) return Error;
    memcpy(bytes, state, sizeof(Data));
    return Ok;
}
EXPORT Status FMI(DeserializeFMUState)(void *m, const Byte bytes[], size_t size, void **state) {
    if (size != sizeof(Data)) return Error;
    if (!*state) *state = malloc(sizeof(Data));
    if (!*state) return Error;
    memcpy(*state, bytes, sizeof(Data));
    return Ok;
}

EXPORT Status FMI(CompletedIntegratorStep)(void *m, Bool no_return, Bool *enter_event_mode, Bool *terminate) {
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
EXPORT Status FMI(GetContinuousStateDerivatives)(Machine *m, double rates[], size_t n) {
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
