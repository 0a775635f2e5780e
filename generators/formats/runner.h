/* Runs test vectors of an EtherCAT SubDevice: portable C99, no allocation, string.h only.
 *
 *     struct ecatspec_target target = { &bench, bench_reset, bench_read, bench_write, bench_advance, NULL };
 *     for (size_t n = 0; n < ECATSPEC_TESTS; n++) {
 *         struct ecatspec_result result = ecatspec_run(&target, n);
 *         if (result.outcome == ECATSPEC_FAILED) ... ecatspec_tests[n].id, result.step, result.clauses
 *     }
 *
 * The tables are below. docs/vectors.md of ecatspec says what they mean. */
#include <stddef.h>
#include <stdint.h>
#include <string.h>

/* What the runner does with the device. `read` and `write` give the working counter: 0 is refused. */
struct ecatspec_target {
    void *context;
    void (*reset)(void *context); /* power cycle */
    int (*read)(void *context, uint16_t address, uint8_t *data, size_t length);
    int (*write)(void *context, uint16_t address, const uint8_t *data, size_t length);
    void (*advance)(void *context, uint32_t microseconds);
    int (*local)(void *context, const char *event); /* 0: cannot make it happen; may be NULL */
};

enum ecatspec_outcome {
    ECATSPEC_PASSED,
    ECATSPEC_ENDED,   /* passed: the device went another way that is allowed, the rest was not tried */
    ECATSPEC_SKIPPED, /* the target cannot raise an event, or test 0 did not pass and was needed */
    ECATSPEC_FAILED
};

struct ecatspec_result {
    enum ecatspec_outcome outcome;
    unsigned step;       /* from 1 */
    unsigned expected;   /* which of its expectations, from 1; 0: what was done was refused */
    const char *clauses; /* the clauses of the rules that had just fired */
    size_t size;         /* bytes of what was seen, in ecatspec_seen */
};

enum { ECATSPEC_WRONG, ECATSPEC_GOES_ON, ECATSPEC_ENDS }; /* what an observation means */
enum { ECATSPEC_LOOK, ECATSPEC_WRITE, ECATSPEC_SEND, ECATSPEC_LOCAL };
enum { ECATSPEC_READ, ECATSPEC_MAIL, ECATSPEC_FULL };
enum { ECATSPEC_ANY, ECATSPEC_NEW, ECATSPEC_SAME };

struct ecatspec_allowed {
    uint32_t value, mask; /* in ecatspec_bytes */
    uint16_t size, least; /* least: a message may be so short; 0: all of it must be there */
    uint8_t effect;
};

struct ecatspec_expected {
    uint8_t kind, none, otherwise, counter; /* none: READ refused, MAIL no message, FULL the truth */
    uint16_t address, length;
    uint32_t allowed; /* the first one */
    uint16_t count;
};

struct ecatspec_step {
    uint8_t kind, counter, otherwise;
    uint16_t address, size;
    uint32_t data; /* in ecatspec_bytes; LOCAL: which of ecatspec_events */
    uint32_t us, cycle_us;
    uint16_t cycle_address, cycle_size;
    uint32_t cycle_data;
    uint32_t expected; /* the first one */
    uint16_t count;
    const char *clauses; /* NULL: those of the step before */
};

struct ecatspec_test {
    const char *id;
    uint32_t first; /* in ecatspec_order, which says the steps */
    uint16_t steps;
    uint8_t requires; /* test 0 must have passed */
};

/* --- the tables -------------------------------------------------------------------------------- */

@TABLES@

/* --- the runner -------------------------------------------------------------------------------- */

static uint8_t ecatspec_seen[ECATSPEC_LONGEST]; /* what was seen last */
static enum ecatspec_outcome ecatspec_configured = ECATSPEC_PASSED; /* what became of test 0 */

struct ecatspec_play {
    const struct ecatspec_target *target;
    struct ecatspec_result *result;
    int counter; /* of the message before; -1: there was none */
};

static uint32_t ecatspec_number(const uint8_t *data, size_t size)
{
    uint32_t number = 0;
    while (size--) number = number << 8 | data[size];
    return number;
}

static int ecatspec_get(struct ecatspec_play *play, uint16_t address, size_t length)
{
    if (length > sizeof ecatspec_seen) return 0;
    memset(ecatspec_seen, 0, sizeof ecatspec_seen);
    return play->target->read(play->target->context, address, ecatspec_seen, length) != 0;
}

static int ecatspec_is_full(struct ecatspec_play *play)
{
    return ecatspec_get(play, ECATSPEC_FULL_ADDRESS, ECATSPEC_FULL_LENGTH)
        && (ecatspec_number(ecatspec_seen, ECATSPEC_FULL_LENGTH) & ECATSPEC_FULL_MASK);
}

/* Give the first that the bytes are, NULL if none; what follows them is not compared. */
static const struct ecatspec_allowed *ecatspec_find(
    const struct ecatspec_allowed *allowed, size_t count, const uint8_t *data, size_t length)
{
    for (; count--; allowed++) {
        const uint8_t *value = ecatspec_bytes + allowed->value, *mask = ecatspec_bytes + allowed->mask;
        size_t size = allowed->size, same = 0;
        if (allowed->least && length < size) size = length < allowed->least ? allowed->least : length;
        if (size > length) continue;
        while (same < size && !((data[same] ^ value[same]) & mask[same])) same++;
        if (same == size) return allowed;
    }
    return NULL;
}

/* Let time pass; process data are written while it does. */
static void ecatspec_wait(struct ecatspec_play *play, const struct ecatspec_step *step, uint32_t us)
{
    const struct ecatspec_target *target = play->target;
    while (us) {
        uint32_t part = step && step->cycle_us && step->cycle_us < us ? step->cycle_us : us;
        target->advance(target->context, part);
        us -= part;
        if (step && step->cycle_us)
            (void)target->write(target->context, step->cycle_address,
                                ecatspec_bytes + step->cycle_data, step->cycle_size);
    }
}

/* Do what a step begins with. */
static int ecatspec_do(struct ecatspec_play *play, const struct ecatspec_step *step)
{
    const struct ecatspec_target *target = play->target;
    uint32_t waited = 0, part = 500;
    int counter;
    switch (step->kind) {
    case ECATSPEC_WRITE:
        counter = target->write(target->context, step->address, ecatspec_bytes + step->data, step->size) != 0;
        return counter == step->counter ? ECATSPEC_GOES_ON : step->otherwise;
    case ECATSPEC_SEND:
        for (;;) {
            memset(ecatspec_seen, 0, sizeof ecatspec_seen);
            memcpy(ecatspec_seen, ecatspec_bytes + step->data, step->size);
            if (target->write(target->context, step->address, ecatspec_seen, ECATSPEC_OUT_LENGTH))
                return ECATSPEC_GOES_ON;
            if (waited > ECATSPEC_REQUEST_US) return ECATSPEC_WRONG;
            ecatspec_wait(play, NULL, part);
            waited += part;
            part *= 4;
        }
    case ECATSPEC_LOCAL:
        if (!target->local || !target->local(target->context, ecatspec_events[step->data])) {
            play->result->outcome = ECATSPEC_SKIPPED;
            return ECATSPEC_ENDS;
        }
        return ECATSPEC_GOES_ON;
    default:
        return ECATSPEC_GOES_ON;
    }
}

static int ecatspec_look_for_mail(struct ecatspec_play *play, const struct ecatspec_expected *expected)
{
    const struct ecatspec_allowed *first = ecatspec_allowed + expected->allowed;
    int tries;
    for (tries = 0; tries < 64; tries++) {
        const struct ecatspec_allowed *found;
        size_t length;
        int before = play->counter;
        if (!ecatspec_is_full(play) || !ecatspec_get(play, ECATSPEC_IN_ADDRESS, ECATSPEC_IN_LENGTH)) {
            play->result->size = 0;
            return expected->none ? expected->none : expected->otherwise;
        }
        length = ECATSPEC_HEAD + ecatspec_number(ecatspec_seen + ECATSPEC_LENGTH_PLACE, ECATSPEC_LENGTH_SIZE);
        if (length > ECATSPEC_IN_LENGTH) length = ECATSPEC_IN_LENGTH;
        play->result->size = length;
        play->counter = (int)(ecatspec_number(ecatspec_seen + ECATSPEC_COUNTER_PLACE, ECATSPEC_COUNTER_SIZE)
                              & ECATSPEC_COUNTER_MASK);
        found = ecatspec_find(first, expected->count, ecatspec_seen, length);
        if (!found && ecatspec_find(ecatspec_pass_over, ECATSPEC_PASS_OVER, ecatspec_seen, length)) continue;
        if (!found && expected->otherwise != ECATSPEC_GOES_ON) return expected->otherwise;
        if (found && found->effect == ECATSPEC_ENDS) return ECATSPEC_ENDS;
        if (!expected->count) continue; /* whatever it is, it is taken away */
        if (before < 0) return ECATSPEC_GOES_ON;
        if (!play->counter != !before) return ECATSPEC_WRONG; /* a device sends 0 always, or never */
        if (expected->counter == ECATSPEC_NEW && play->counter == before && before) return ECATSPEC_WRONG;
        if (expected->counter == ECATSPEC_SAME && play->counter != before) return ECATSPEC_WRONG;
        return ECATSPEC_GOES_ON;
    }
    return expected->count ? ECATSPEC_ENDS : ECATSPEC_GOES_ON; /* no end, and never what was waited for */
}

static int ecatspec_look(struct ecatspec_play *play, const struct ecatspec_expected *expected)
{
    const struct ecatspec_allowed *found;
    switch (expected->kind) {
    case ECATSPEC_MAIL:
        return ecatspec_look_for_mail(play, expected);
    case ECATSPEC_FULL:
        play->result->size = ECATSPEC_FULL_LENGTH;
        return ecatspec_is_full(play) == expected->none ? ECATSPEC_GOES_ON : expected->otherwise;
    default:
        play->result->size = 0;
        if (!ecatspec_get(play, expected->address, expected->length)) return expected->none;
        play->result->size = expected->length;
        found = ecatspec_find(ecatspec_allowed + expected->allowed, expected->count, ecatspec_seen, expected->length);
        return found ? found->effect : expected->otherwise;
    }
}

/* Run one test from power-on; run test 0 first, since others may rest on it. */
static struct ecatspec_result ecatspec_run(const struct ecatspec_target *target, size_t number)
{
    const struct ecatspec_test *test = ecatspec_tests + number;
    struct ecatspec_result result = { ECATSPEC_PASSED, 0, 0, "", 0 };
    struct ecatspec_play play;
    int effect = ECATSPEC_GOES_ON;
    unsigned place;
    play.target = target;
    play.result = &result;
    play.counter = -1;
    if (test->requires && ecatspec_configured != ECATSPEC_PASSED) {
        result.outcome = ECATSPEC_SKIPPED;
        return result;
    }
    target->reset(target->context);
    for (place = 0; place < test->steps && effect == ECATSPEC_GOES_ON; place++) {
        const struct ecatspec_step *step = ecatspec_steps + ecatspec_order[test->first + place];
        if (step->clauses) result.clauses = step->clauses;
        result.step = place + 1;
        result.expected = 0;
        effect = ecatspec_do(&play, step);
        if (effect != ECATSPEC_GOES_ON) break;
        ecatspec_wait(&play, step, step->us);
        while (result.expected < step->count && effect == ECATSPEC_GOES_ON)
            effect = ecatspec_look(&play, ecatspec_expected + step->expected + result.expected++);
    }
    if (effect == ECATSPEC_WRONG) result.outcome = ECATSPEC_FAILED;
    else if (effect == ECATSPEC_ENDS && result.outcome == ECATSPEC_PASSED) result.outcome = ECATSPEC_ENDED;
    if (number == 0) ecatspec_configured = result.outcome;
    return result;
}
