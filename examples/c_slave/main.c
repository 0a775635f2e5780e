/* The device as a program: one JSON request a line on stdin, one reply a line on stdout.
 *
 *   {"op":"describe"}  {"op":"reset"}  {"op":"close"}
 *   {"op":"read","address":304,"length":2}   {"op":"write","address":288,"data":"0200"}
 *   {"op":"advance","seconds":0.5}           {"op":"local","event":"ds402.fault"} */
#include "device.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { LONGEST_LINE = 1 << 18, MICROSECONDS = 1000000 };

static struct device device;
static char line[LONGEST_LINE];
static uint8_t bytes[ESC_SIZE];

/* What a request can say; a text that is absent is a null pointer. */
struct request {
    const char *op, *data, *event;
    long address, length;
    double seconds;
};

static char *skip(char *at)
{
    return at + strspn(at, " \t\r\n");
}

/* Take a string without escapes, the only kind that requests have; its end becomes a zero. */
static char *take_string(char *at, const char **text)
{
    char *end;
    if (*at != '"') {
        return NULL;
    }
    end = at + 1 + strcspn(at + 1, "\"\\");
    if (*end != '"') {
        return NULL;
    }
    *end = '\0';
    *text = at + 1;
    return skip(end + 1);
}

static char *take_value(char *at, const char *key, struct request *request)
{
    const char *text = NULL;
    char *end;
    double number;
    if (*at == '"') {
        end = take_string(at, &text);
    } else {
        number = strtod(at, &end);
        if (end == at || !(number >= 0)) {
            return NULL;
        }
        request->seconds = strcmp(key, "seconds") == 0 ? number : request->seconds;
        request->address = strcmp(key, "address") == 0 && number < ESC_SIZE ? (long)number
                                                                            : request->address;
        request->length = strcmp(key, "length") == 0 && number <= ESC_SIZE ? (long)number
                                                                           : request->length;
        end = skip(end);
    }
    request->op = text != NULL && strcmp(key, "op") == 0 ? text : request->op;
    request->data = text != NULL && strcmp(key, "data") == 0 ? text : request->data;
    request->event = text != NULL && strcmp(key, "event") == 0 ? text : request->event;
    return end;
}

/* Returns whether the line is one flat object. */
static int take_request(char *at, struct request *request)
{
    const char *key;
    static const struct request nothing = { NULL, NULL, NULL, -1, -1, -1 };
    *request = nothing;
    at = skip(at);
    do {
        if (*at != '{' && *at != ',') {
            return 0;
        }
        at = take_string(skip(at + 1), &key);
        if (at == NULL || *at != ':') {
            return 0;
        }
        at = take_value(skip(at + 1), key, request);
        if (at == NULL) {
            return 0;
        }
    } while (*at == ',');
    return *at == '}' && *skip(at + 1) == '\0' && request->op != NULL;
}

static void complain(const char *error)
{
    printf("{\"ok\":false,\"error\":\"%s\"}\n", error);
}

static void describe(void)
{
    int n;
    printf("{\"ok\":true,\"description\":{\"name\":\"c_slave\",\"protocols\":[\"al\",\"coe\","
           "\"ds402\",\"emergency\",\"esc\",\"mailbox\",\"process_data\",\"sdo\","
           "\"sdo_information\"],\"virtual_time\":true,\"closed_dictionary\":true,\"locals\":[");
    for (n = 0; application_events[n] != NULL; n++) {
        printf("%s\"%s\"", n > 0 ? "," : "", application_events[n]);
    }
    printf("]}}\n");
}

static void read_memory(const struct request *request)
{
    int counter;
    long n;
    if (request->address < 0 || request->length < 1
        || request->length > ESC_SIZE - request->address) {
        complain("read needs an address and a length inside the memory");
        return;
    }
    counter = device_read(&device, (uint16_t)request->address, bytes, (size_t)request->length);
    printf("{\"ok\":true,\"wkc\":%d,\"data\":\"", counter);
    for (n = 0; n < request->length; n++) {
        printf("%02x", bytes[n]);
    }
    printf("\"}\n");
}

static int digit(char character)
{
    static const char digits[] = "0123456789abcdef";
    const char *found = strchr(digits, character);
    return found == NULL || character == '\0' ? -1 : (int)(found - digits);
}

static void write_memory(const struct request *request)
{
    long n, length = request->data == NULL ? 0 : (long)strlen(request->data) / 2;
    if (request->address < 0 || length < 1 || length > ESC_SIZE - request->address
        || strlen(request->data) % 2 != 0) {
        complain("write needs an address, and data in hexadecimal, inside the memory");
        return;
    }
    for (n = 0; n < length; n++) {
        int high = digit(request->data[2 * n]), low = digit(request->data[2 * n + 1]);
        if (high < 0 || low < 0) {
            complain("the data of a write are not lower-case hexadecimal");
            return;
        }
        bytes[n] = (uint8_t)(high << 4 | low);
    }
    printf("{\"ok\":true,\"wkc\":%d}\n",
           device_write(&device, (uint16_t)request->address, bytes, (size_t)length));
}

static void advance(const struct request *request)
{
    double left = request->seconds * MICROSECONDS + 0.5;
    if (request->seconds < 0) {
        complain("advance needs a number of seconds");
        return;
    }
    for (; left > UINT32_MAX; left -= UINT32_MAX) {
        device_advance(&device, UINT32_MAX);
    }
    device_advance(&device, (uint32_t)left);
    puts("{\"ok\":true}");
}

/* Returns whether there is more to come. */
static int serve(const struct request *request)
{
    if (strcmp(request->op, "describe") == 0) {
        describe();
    } else if (strcmp(request->op, "read") == 0) {
        read_memory(request);
    } else if (strcmp(request->op, "write") == 0) {
        write_memory(request);
    } else if (strcmp(request->op, "advance") == 0) {
        advance(request);
    } else if (strcmp(request->op, "local") == 0) {
        if (request->event == NULL || device_local(&device, request->event) != 0) {
            complain("local needs an event of the description");
        } else {
            puts("{\"ok\":true}");
        }
    } else if (strcmp(request->op, "reset") == 0) {
        device_reset(&device);
        puts("{\"ok\":true}");
    } else if (strcmp(request->op, "close") == 0) {
        puts("{\"ok\":true}");
        return 0;
    } else {
        complain("unknown op");
    }
    return 1;
}

int main(void)
{
    struct request request;
    int more = 1;
    device_reset(&device);
    while (more && fgets(line, sizeof line, stdin) != NULL) {
        if (take_request(line, &request)) {
            more = serve(&request);
        } else {
            complain("the line is no request");
        }
        fflush(stdout);
    }
    return 0;
}
