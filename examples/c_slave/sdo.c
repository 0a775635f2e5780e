/* CANopen over EtherCAT: the SDO server. Messages begin with the two bytes of the CoE header. */
#include "faults.h"
#include "slave.h"

#include <string.h>

enum { COE_HEADER = 2, AT_SERVICE = 1, SDO_REQUEST = 2, SDO_RESPONSE = 3 };
enum { AT_COMMAND = 2, AT_INDEX = 3, AT_SUBINDEX = 5, AT_DATA = 6, SEGMENT_DATA = 3,
       INITIATE_NORMAL_DATA = 10, SHORTEST_SDO = 10, EXPEDITED_SIZE = 4, SMALLEST_SEGMENT = 7 };
enum { DOWNLOAD_SEGMENT = 0, INITIATE_DOWNLOAD = 1, INITIATE_UPLOAD = 2, UPLOAD_SEGMENT = 3,
       ABORT_TRANSFER = 4 };
enum { SIZE_INDICATED = 0x01, EXPEDITED = 0x02, UNUSED = 0x0C, COMPLETE_ACCESS = 0x10,
       LAST = 0x01, TOGGLE = 0x10 };
enum { RESPONSE_UPLOAD_SEGMENT = 0x00, RESPONSE_DOWNLOAD_SEGMENT = 0x20, RESPONSE_UPLOAD = 0x40,
       RESPONSE_DOWNLOAD = 0x60, ABORT = 0x80 };
enum { SERVICE_UNSUPPORTED = 4, SIZE_TOO_SHORT = 6, INVALID_SIZE = 8 };
enum { MESSAGE_ROOM = MAILBOX_IN_LENGTH - 6, UPLOAD_ROOM = MESSAGE_ROOM - INITIATE_NORMAL_DATA,
       SEGMENT_ROOM = MESSAGE_ROOM - SEGMENT_DATA };

void sdo_start(struct slave *slave)
{
    memset(&slave->sdo, 0, sizeof slave->sdo);
}

static size_t lesser(size_t a, size_t b)
{
    return a < b ? a : b;
}

static int respond(uint8_t *reply, int service, int command, uint16_t index, uint8_t subindex)
{
    reply[AT_SERVICE] = (uint8_t)(service << 4);
    reply[AT_COMMAND] = (uint8_t)command;
    put16(reply + AT_INDEX, index);
    reply[AT_SUBINDEX] = subindex;
    return SHORTEST_SDO;
}

static int refuse(struct sdo *sdo, uint8_t *reply, uint32_t code)
{
    sdo->transfer = NO_TRANSFER;
    put32(reply + AT_DATA, code);
    return respond(reply, SDO_REQUEST, ABORT, sdo->index, sdo->subindex);
}

static int respond_segment(struct sdo *sdo, uint8_t *reply, int command)
{
    reply[AT_SERVICE] = SDO_RESPONSE << 4;
    reply[AT_COMMAND] = (uint8_t)(command | sdo->toggle);
    sdo->toggle ^= TOGGLE;
    return SHORTEST_SDO;
}

/* --- upload ---------------------------------------------------------------------------------- */

static int initiate_upload(struct slave *slave, uint8_t *reply)
{
    struct sdo *sdo = &slave->sdo;
    uint32_t code = object_read(slave, sdo->index, sdo->subindex, sdo->data, &sdo->size);
    if (code != ABORT_NONE) {
        return refuse(sdo, reply, code);
    }
    if (sdo->size >= 1 && sdo->size <= EXPEDITED_SIZE) {
        memcpy(reply + AT_DATA, sdo->data, sdo->size);
        return respond(reply, SDO_RESPONSE,
                       RESPONSE_UPLOAD | SIZE_INDICATED | EXPEDITED
                       | (int)(EXPEDITED_SIZE - sdo->size) << 2,
                       sdo->index, sdo->subindex);
    }
    sdo->done = lesser(sdo->size, UPLOAD_ROOM);
    sdo->toggle = 0;
    sdo->transfer = sdo->done < sdo->size ? UPLOAD : NO_TRANSFER;
    put32(reply + AT_DATA, (uint32_t)sdo->size);
    memcpy(reply + INITIATE_NORMAL_DATA, sdo->data, sdo->done);
    return respond(reply, SDO_RESPONSE, RESPONSE_UPLOAD | SIZE_INDICATED, sdo->index, sdo->subindex)
           + (int)sdo->done;
}

static int upload_segment(struct sdo *sdo, const uint8_t *request, uint8_t *reply)
{
    size_t part = lesser(sdo->size - sdo->done, SEGMENT_ROOM);
    int command = RESPONSE_UPLOAD_SEGMENT, length;
    if (sdo->transfer != UPLOAD) {
        return refuse(sdo, reply, ABORT_COMMAND);
    }
    if ((request[AT_COMMAND] & TOGGLE) != sdo->toggle) {
        return refuse(sdo, reply, ABORT_TOGGLE);
    }
    memcpy(reply + SEGMENT_DATA, sdo->data + sdo->done, part);
    sdo->done += part;
    if (sdo->done == sdo->size) {
        sdo->transfer = NO_TRANSFER;
        command |= PLANTED(SEGMENT_LAST_FORGOTTEN) ? 0 : LAST;
    }
    if (part < SMALLEST_SEGMENT) {
        command |= (int)(SMALLEST_SEGMENT - part) << 1;
    }
    length = respond_segment(sdo, reply, command);
    return part < SMALLEST_SEGMENT ? length : SEGMENT_DATA + (int)part;
}

/* --- download -------------------------------------------------------------------------------- */

static int download_expedited(struct slave *slave, const uint8_t *request, uint8_t *reply)
{
    struct sdo *sdo = &slave->sdo;
    int command = request[AT_COMMAND];
    size_t unused = (size_t)(command & UNUSED) >> 2;
    size_t size = EXPEDITED_SIZE - unused;
    uint32_t code;
    if (!(command & SIZE_INDICATED)) {
        if (unused > 0) {
            return refuse(sdo, reply, ABORT_GENERAL);
        }
        size = lesser(size, object_size(sdo->index, sdo->subindex));
    }
    code = object_write(slave, sdo->index, sdo->subindex, NULL, size);
    if (code == ABORT_NONE) {
        code = object_write(slave, sdo->index, sdo->subindex, request + AT_DATA, size);
    }
    return code != ABORT_NONE ? refuse(sdo, reply, code)
           : respond(reply, SDO_RESPONSE, RESPONSE_DOWNLOAD, sdo->index, sdo->subindex);
}

static int download_normal(struct slave *slave, const uint8_t *request, size_t length,
                           uint8_t *reply)
{
    struct sdo *sdo = &slave->sdo;
    size_t present = length - INITIATE_NORMAL_DATA;
    int command = request[AT_COMMAND];
    uint32_t code, size = get32(request + AT_DATA);
    if (!(command & SIZE_INDICATED) || command & UNUSED || size < present) {
        return refuse(sdo, reply, ABORT_LENGTH);
    }
    code = object_write(slave, sdo->index, sdo->subindex, NULL, size);
    if (code == ABORT_NONE && present == size) {
        code = object_write(slave, sdo->index, sdo->subindex, request + INITIATE_NORMAL_DATA,
                            size);
    } else if (code == ABORT_NONE) {
        sdo->transfer = DOWNLOAD;
        sdo->toggle = 0;
        sdo->size = size;
        sdo->done = present;
        memcpy(sdo->data, request + INITIATE_NORMAL_DATA, present);
    }
    return code != ABORT_NONE ? refuse(sdo, reply, code)
           : respond(reply, SDO_RESPONSE, RESPONSE_DOWNLOAD, sdo->index, sdo->subindex);
}

static int download_segment(struct slave *slave, const uint8_t *request, size_t length,
                            uint8_t *reply)
{
    struct sdo *sdo = &slave->sdo;
    int command = request[AT_COMMAND];
    size_t part = length - SEGMENT_DATA;
    uint32_t code = ABORT_NONE;
    if (length == SHORTEST_SDO) {
        part -= (size_t)(command >> 1 & SMALLEST_SEGMENT);
    }
    if (sdo->transfer != DOWNLOAD) {
        return refuse(sdo, reply, ABORT_COMMAND);
    }
    if ((command & TOGGLE) != sdo->toggle && !PLANTED(SEGMENT_TOGGLE_UNCHECKED)) {
        return refuse(sdo, reply, ABORT_TOGGLE);
    }
    if (part > sdo->size - sdo->done) {
        return refuse(sdo, reply, ABORT_TOO_LONG);
    }
    memcpy(sdo->data + sdo->done, request + SEGMENT_DATA, part);
    sdo->done += part;
    if (command & LAST) {
        if (sdo->done < sdo->size && !PLANTED(SEGMENT_LAST_TOO_EARLY)) {
            return refuse(sdo, reply, ABORT_TOO_SHORT);
        }
        sdo->transfer = NO_TRANSFER;
        code = object_write(slave, sdo->index, sdo->subindex, sdo->data, sdo->done);
    }
    return code != ABORT_NONE ? refuse(sdo, reply, code)
           : respond_segment(sdo, reply, RESPONSE_DOWNLOAD_SEGMENT);
}

/* --- services -------------------------------------------------------------------------------- */

/* A request to begin something ends a transfer that is open. */
static int initiate(struct slave *slave, const uint8_t *request, size_t length, uint8_t *reply)
{
    struct sdo *sdo = &slave->sdo;
    sdo->transfer = NO_TRANSFER;
    sdo->index = get16(request + AT_INDEX);
    sdo->subindex = request[AT_SUBINDEX];
    if (request[AT_COMMAND] & COMPLETE_ACCESS) {
        return refuse(sdo, reply, object_size(sdo->index, 0) ? ABORT_UNSUPPORTED_ACCESS
                                                            : ABORT_NO_OBJECT);
    }
    if (request[AT_COMMAND] >> 5 == INITIATE_UPLOAD) {
        return initiate_upload(slave, reply);
    }
    return request[AT_COMMAND] & EXPEDITED ? download_expedited(slave, request, reply)
                                           : download_normal(slave, request, length, reply);
}

static int sdo_serve(struct slave *slave, const uint8_t *request, size_t length, uint8_t *reply)
{
    struct sdo *sdo = &slave->sdo;
    int command = request[AT_COMMAND] >> 5;
    if (command <= ABORT_TRANSFER && length < SHORTEST_SDO) {
        return -INVALID_SIZE;
    }
    switch (command) {
    case INITIATE_DOWNLOAD:
    case INITIATE_UPLOAD:
        return initiate(slave, request, length, reply);
    case DOWNLOAD_SEGMENT:
        return download_segment(slave, request, length, reply);
    case UPLOAD_SEGMENT:
        return upload_segment(sdo, request, reply);
    case ABORT_TRANSFER:
        sdo->transfer = NO_TRANSFER;
        return 0;
    default:
        return refuse(sdo, reply, ABORT_COMMAND);
    }
}

int coe_serve(struct slave *slave, const uint8_t *request, size_t length, uint8_t *reply)
{
    if (request[AT_SERVICE] >> 4 != SDO_REQUEST) {
        return -SERVICE_UNSUPPORTED;
    }
    if (length <= COE_HEADER) {
        return -SIZE_TOO_SHORT;
    }
    return sdo_serve(slave, request, length, reply);
}
