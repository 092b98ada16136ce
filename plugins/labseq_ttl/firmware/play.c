// Outputs, and the playing of programs. Timer 1 counts ticks of 0.5 us.
// Interrupts only wake the processor: an edge itself is made by a loop that nothing can interrupt.

#include "box.h"

#include <avr/interrupt.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <util/atomic.h>

#define RECEIVE _BV(PD0)  // pulled up: an open line sends nothing
#define START _BV(PB0)    // pulled up: an open input never rises

#define FIRST 40  // ticks from the start to the first edge
#define NEAR 48   // ticks before an edge from which nothing is listened to: all interrupts and the leader take 30

uint16_t polarity, held;
volatile uint8_t stop;
volatile uint16_t age, beats;
volatile uint8_t started;

static volatile uint16_t started_at;

ISR(TIMER1_OVF_vect) {
  age++;
  beats++;
}

ISR(TIMER1_CAPT_vect) {
  started_at = ICR1;
  started = 1;
  TIMSK1 &= ~_BV(ICIE1);  // the first edge alone
}

EMPTY_INTERRUPT(TIMER1_COMPB_vect)

// Sleep until an interrupt. Interrupts are off before and after; none that comes in between is missed.
void nap(void) {
  sleep_enable();
  sei();
  sleep_cpu();
  sleep_disable();
  cli();
}

void show(uint16_t mask) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    uint16_t levels = ((mask | signs) ^ polarity) & OUTPUTS;
    held = mask;
    PORTB = (levels >> 8) | START | (PORTB & GATE);
    PORTD = levels | RECEIVE;
  }
}

// Wait for a tick less than 2^15 away; 0 if the host said stop. Interrupts are off afterwards.
static uint8_t until(uint16_t tick) {
  OCR1B = tick;
  TIFR1 = _BV(OCF1B);
  TIMSK1 |= _BV(OCIE1B);
  cli();
  wdt_reset();
  while (!stop && (int16_t)(TCNT1 - tick) < 0) {
    nap();
    wdt_reset();
    look_at_leader();
  }
  return !stop;
}

// The edges of a program whose start was at a tick; 0 if it was stopped. Interrupts are off afterwards.
static uint8_t make_edges(const edge_t *edge, uint8_t n, uint16_t due) {
  for (uint8_t i = 0; i < n; i++, edge++) {
    uint32_t left = i ? edge->ticks : FIRST;
    while (left > 0x7FFF) {
      due += 0x4000;
      left -= 0x4000;
      if (!until(due)) return 0;
    }
    due += left;
    if ((uint16_t)left > NEAR && !until(due - NEAR)) return 0;
    uint16_t levels = (edge->mask | signs) ^ polarity;
    uint8_t b = (levels >> 8) | START | GATE, d = levels | RECEIVE;
    OCR1A = due;
    TIFR1 = _BV(OCF1A);
    asm volatile(
        "1: sbis %[flags], %[match]\n"  // 3 cycles each time round: an edge is at most 2 late
        "   rjmp 1b\n"
        "   out %[portb], %[b]\n"
        "   out %[portd], %[d]\n"  // 1 cycle after port B
        ::[flags] "I"(_SFR_IO_ADDR(TIFR1)), [match] "I"(OCF1A), [portb] "I"(_SFR_IO_ADDR(PORTB)),
        [portd] "I"(_SFR_IO_ADDR(PORTD)), [b] "r"(b), [d] "r"(d));
    held = edge->mask;
  }
  return 1;
}

static uint8_t wait_for_start(void) {
  started = 0;
  TIFR1 = _BV(ICF1);
  TIMSK1 |= _BV(ICIE1);
  while (!started && !stop) {
    wdt_reset();
    nap();
  }
  TIMSK1 &= ~_BV(ICIE1);
  return started;
}

uint8_t play(const edge_t *edge, uint8_t n, uint8_t external) {
  uint8_t finished = 0;
  cli();
  if (!external) {
    started_at = TCNT1;
    finished = !stop && make_edges(edge, n, started_at);
  } else if (wait_for_start() && !stop) {
    finished = make_edges(edge, n, started_at);
  }
  PORTB &= ~GATE;
  TIMSK1 &= ~_BV(OCIE1B);
  drop_received();
  age = 0;
  sei();
  return finished;
}

void start_timer(void) {
  TCCR1B = _BV(ICNC1) | _BV(ICES1) | _BV(CS11);  // rising edges, with noise canceller; 16 MHz / 8
  TIMSK1 = _BV(TOIE1);
  set_sleep_mode(SLEEP_MODE_IDLE);
}
