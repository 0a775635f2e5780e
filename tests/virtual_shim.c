/* The virtual SubDevice as a shared library of level A: each device is a process that speaks the line
 * protocol. COMMAND is what starts it, LOCALS the local events that it takes. */
#define _POSIX_C_SOURCE 200809L
#include <ecatspec_dut.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <unistd.h>

#define LONGEST 0x21000

struct shim {
    pid_t process;
    FILE *requests, *replies;
    char line[LONGEST];
};

static const char *const command[] = { COMMAND, NULL };

static void exchange(struct shim *shim)
{
    fflush(shim->requests);
    if (fgets(shim->line, sizeof shim->line, shim->replies) == NULL
        || strstr(shim->line, "\"ok\":true") == NULL) {
        fprintf(stderr, "the virtual SubDevice says: %s\n", shim->line);
        abort();
    }
}

static void *create(void)
{
    struct shim *shim = calloc(1, sizeof *shim);
    int to[2], from[2];
    if (shim == NULL || pipe(to) || pipe(from) || (shim->process = fork()) < 0) {
        return NULL;
    }
    if (shim->process == 0) {
        dup2(to[0], 0);
        dup2(from[1], 1);
        close(to[1]);
        close(from[0]);
        execv(command[0], (char *const *)command);
        _exit(127);
    }
    close(to[0]);
    close(from[1]);
    shim->requests = fdopen(to[1], "w");
    shim->replies = fdopen(from[0], "r");
    return shim;
}

static void destroy(void *device)
{
    struct shim *shim = device;
    fclose(shim->requests);
    fclose(shim->replies);
    waitpid(shim->process, NULL, 0);
    free(shim);
}

static void reset(void *device)
{
    struct shim *shim = device;
    fputs("{\"op\":\"reset\"}\n", shim->requests);
    exchange(shim);
}

static int working_counter(const struct shim *shim)
{
    return atoi(strstr(shim->line, "\"wkc\":") + strlen("\"wkc\":"));
}

static int read_memory(void *device, uint16_t address, uint8_t *data, size_t length)
{
    struct shim *shim = device;
    const char *digits;
    size_t place;
    fprintf(shim->requests, "{\"op\":\"read\",\"address\":%u,\"length\":%zu}\n", address, length);
    exchange(shim);
    digits = strstr(shim->line, "\"data\":\"") + strlen("\"data\":\"");
    for (place = 0; place < length; place++, digits += 2) {
        unsigned byte = 0;
        sscanf(digits, "%2x", &byte);
        data[place] = (uint8_t)byte;
    }
    return working_counter(shim);
}

static int write_memory(void *device, uint16_t address, const uint8_t *data, size_t length)
{
    struct shim *shim = device;
    size_t place;
    fprintf(shim->requests, "{\"op\":\"write\",\"address\":%u,\"data\":\"", address);
    for (place = 0; place < length; place++) {
        fprintf(shim->requests, "%02x", data[place]);
    }
    fputs("\"}\n", shim->requests);
    exchange(shim);
    return working_counter(shim);
}

static void advance(void *device, uint64_t microseconds)
{
    struct shim *shim = device;
    fprintf(shim->requests, "{\"op\":\"advance\",\"seconds\":%llu.%06llu}\n",
            (unsigned long long)(microseconds / 1000000), (unsigned long long)(microseconds % 1000000));
    exchange(shim);
}

static int local(void *device, const char *event)
{
    struct shim *shim = device;
    fprintf(shim->requests, "{\"op\":\"local\",\"event\":\"%s\"}\n", event);
    exchange(shim);
    return 0;
}

const struct ecatspec_dut *ecatspec_dut(void)
{
    static const struct ecatspec_device device = {
        create, destroy, reset, read_memory, write_memory, advance, local
    };
    static const struct ecatspec_dut dut = {
        .abi = ECATSPEC_DUT_ABI, .name = "virtual SubDevice", .locals = LOCALS, .device = &device
    };
    return &dut;
}
