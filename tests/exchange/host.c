/* A host of a functional mock-up unit without Python: steps of co-simulation, the last values on a line. */
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>

static void logged(void *environment, const char *name, int status, const char *category, const char *message, ...) {
    fprintf(stderr, "%s: %s\n", name, message);
}
typedef struct {
    void (*log)(void *, const char *, int, const char *, const char *, ...);
    void *allocate, *release, *finished, *environment;
} Callbacks;

/* host LIBRARY TOKEN END STEPS REFERENCE ... */
int main(int count, char **word) {
    Callbacks callbacks = {logged, 0, 0, 0, 0};
    double end = atof(word[3]), steps = atof(word[4]), value;
    void *library = dlopen(word[1], RTLD_NOW);
    if (!library) return puts(dlerror()), 1;
    void *(*instantiate)(const char *, int, const char *, const char *, Callbacks *, int, int);
    int (*set_up)(void *, int, double, double, int, double), (*enter)(void *), (*leave)(void *);
    int (*step)(void *, double, double, int), (*get)(void *, const unsigned *, size_t, double *);
    *(void **)&instantiate = dlsym(library, "fmi2Instantiate");
    *(void **)&set_up = dlsym(library, "fmi2SetupExperiment");
    *(void **)&enter = dlsym(library, "fmi2EnterInitializationMode");
    *(void **)&leave = dlsym(library, "fmi2ExitInitializationMode");
    *(void **)&step = dlsym(library, "fmi2DoStep");
    *(void **)&get = dlsym(library, "fmi2GetReal");
    void *machine = instantiate("machine", 1, word[2], 0, &callbacks, 0, 0);
    if (!machine || set_up(machine, 0, 0, 0, 0, 0) || enter(machine) || leave(machine)) return 2;
    for (double n = 0; n < steps; n++)
        if (step(machine, n * end / steps, end / steps, 0)) return 3;
    for (int k = 5; k < count; k++) {
        unsigned reference = atoi(word[k]);
        if (get(machine, &reference, 1, &value)) return 4;
        printf("%.17g ", value);
    }
    return 0;
}
