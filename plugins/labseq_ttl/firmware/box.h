// What the parts of the firmware share: play.c makes edges, line.c speaks, labseq_ttl.c obeys.

#ifndef BOX_H
#define BOX_H

#include <avr/io.h>
#include <stdint.h>

#define PROTOCOL 1
#define SLOTS 8
#define EDGES 24

#define OUTPUTS_D 0xFC
#define OUTPUTS_B 0x1E
#define OUTPUTS ((OUTPUTS_B << 8) | OUTPUTS_D)
#define GATE _BV(PB5)

#define SHORTEST 10  // ticks between two edges: the loop that makes them needs 8
#define LINE 96
#define RING 64

typedef struct {
  uint32_t ticks;  // since the edge before
  uint16_t mask;
} edge_t;

// play.c
extern uint16_t polarity;      // outputs that are low when they are on
extern uint16_t held;          // what is on
extern volatile uint8_t stop;  // the host said so
extern volatile uint16_t age;  // overflows of the timer since the last byte
void start_timer(void);
void nap(void);           // sleep until an interrupt; interrupts are off before and after
void show(uint16_t mask);  // turn lines on and off now
// Play a program now, or at the next edge of the start input; 0 if it was stopped.
uint8_t play(const edge_t *edge, uint8_t n, uint8_t external);

// line.c
extern char line[LINE + 1];  // what was received: tag, space, command
void start_line(void);
uint8_t line_waits(void);  // whether a byte has come
uint8_t receive(void);     // take it; 1 at the end of a line
void drop_received(void);
void drop_line(void);
uint8_t undamaged(void);                         // whether the line ends in its own checksum, which is cut off
uint8_t is_command(const char *name);            // its arguments are read next
uint8_t number(uint32_t *value, uint32_t most);  // the next argument; 0 if there is none, or a larger one
uint8_t mask_given(uint32_t *value);             // the same, and all its bits are outputs
uint8_t at_end(void);                            // whether all arguments were read
void begin(const char *text);
void reply(const char *text);  // begin with the tag of what was received
void say_number(uint32_t number, uint8_t n_digits);
void end(void);
void accept(void);
void refuse(const char *reason);
uint16_t checksum(const void *data, uint8_t n);

#endif
