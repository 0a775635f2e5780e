/* What the thermostat offers. Both functions return an SDO abort code, 0 if all went well; without
 * data `write_object` only says whether it would take that number of bytes. */
#ifndef APPLICATION_H
#define APPLICATION_H

#include <stddef.h>
#include <stdint.h>

void switch_on(void);
uint32_t read_object(uint16_t index, uint8_t subindex, uint8_t *data, size_t *length);
uint32_t write_object(uint16_t index, uint8_t subindex, const uint8_t *data, size_t length);

#endif
