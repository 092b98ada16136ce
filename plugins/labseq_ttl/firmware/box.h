// What the parts of the firmware share: play.c makes edges, lead.c hears go, line.c speaks, labseq_ttl.c obeys.

#ifndef BOX_H
#define BOX_H

#include <avr/io.h>
#include <stdint.h>

#define PROTOCOL 2
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
extern volatile uint16_t age;    // overflows of the timer since the last byte
extern volatile uint16_t beats;  // overflows of the timer
extern volatile uint8_t started;  // the start input rose while its interrupt was on
void start_timer(void);
void nap(void);           // sleep until an interrupt; interrupts are off before and after
void show(uint16_t mask);  // turn lines on and off now; signs stay
// Play a program now, or at the next edge of the start input; 0 if it was stopped.
uint8_t play(const edge_t *edge, uint8_t n, uint8_t external);

// lead.c
enum { DEAF, IDLE, OWED, LATE };  // LATE: the deadline of a go has passed, and it was answered
extern uint8_t lead;      // one of these
extern uint16_t signs;    // outputs that are on for the leader, beside those of the lines
extern uint16_t n_gos;    // edges that were taken since the start
extern uint8_t went;      // one that was not told yet
void begin_leading(uint16_t busy_at, uint16_t ready_at, uint16_t failed_at, uint16_t overflows);
void end_leading(void);
void look_at_leader(void);  // take an edge, keep the deadline; interrupts are off
uint8_t more_came(void);    // whether an edge came that could not be taken
uint8_t level(void);        // of the start input
void answer_leader(uint8_t is_ready);

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
