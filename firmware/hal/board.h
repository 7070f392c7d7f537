// Copyright 2026 The t3mpc_ros developers
//
// Licensed under the Apache License, Version 2.0 (the "License");
// you may not use this file except in compliance with the License.
// You may obtain a copy of the License at
//
//     http://www.apache.org/licenses/LICENSE-2.0
//
// Unless required by applicable law or agreed to in writing, software
// distributed under the License is distributed on an "AS IS" BASIS,
// WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
// See the License for the specific language governing permissions and
// limitations under the License.

// Which pin is what, on both boards. Both run at 16 MHz and 5 V; the radio chip's supply is 3.3 V.
#ifndef BOARD_H
#define BOARD_H

#include <avr/io.h>

#if defined(__AVR_ATmega328P__)

// Dongle: Arduino Nano or Uno, radio at D9 to D13 and D2.
#define SERIAL_RX_VECTOR USART_RX_vect
#define SERIAL_EMPTY_VECTOR USART_UDRE_vect
#define SERIAL_ROOM 255u  // bytes that wait at most
#define SPI_DDR DDRB
#define SPI_PORT PORTB
#define SPI_SCK PB5
#define SPI_MOSI PB3
#define SPI_MISO PB4
#define RADIO_CSN PB2  // the SPI's own SS pin: as an output it cannot make the SPI a slave
#define RADIO_CE PB1
#define RADIO_IRQ_HIGH (PIND & _BV(PD2))
#define RADIO_IRQ_VECTOR INT0_vect
#define RADIO_IRQ_SETUP()                                                                         \
    do {                                                                                          \
        EICRA = _BV(ISC01);                                                                       \
        EIMSK = _BV(INT0);                                                                        \
    } while (0)

#elif defined(__AVR_ATmega2560__)

// Robot: Arduino Mega, radio at 50 to 53, 10 and 2.
#define SERIAL_RX_VECTOR USART0_RX_vect
#define SERIAL_EMPTY_VECTOR USART0_UDRE_vect
#define SERIAL_ROOM 96u  // the longest frame, and the zero before it
#define SPI_DDR DDRB
#define SPI_PORT PORTB
#define SPI_SCK PB1
#define SPI_MOSI PB2
#define SPI_MISO PB3
#define RADIO_CSN PB0
#define RADIO_CE PB4
#define RADIO_IRQ_HIGH (PINE & _BV(PE4))
#define RADIO_IRQ_VECTOR INT4_vect
#define RADIO_IRQ_SETUP()                                                                         \
    do {                                                                                          \
        EICRB = _BV(ISC41);                                                                       \
        EIMSK = _BV(INT4);                                                                        \
    } while (0)

// Steppers at 22 to 26, in the order of t3_steps.h; the drivers' enable input is active low. It
// needs a pull-up of its own: no pin drives it while the board resets.
#define STEPPER_DDR DDRA
#define STEPPER_PORT PORTA
#define STEPPER_OFF PA4
// Emergency stop at 3: a normally closed contact to ground, so that a broken wire stops the robot.
#define ESTOP_PORT PORTE
#define ESTOP_PRESSED (PINE & _BV(PE5))
#define ESTOP_PULL_UP PE5
// LED of the board at 13; an active buzzer, or nothing, at 11: on the port of the SPI, whose bits are set
// one at a time.
#define SIGNAL_DDR DDRB
#define SIGNAL_PORT PORTB
#define SIGNAL_LED PB7
#define SIGNAL_BUZZER PB5
// Distance sensors at A0 to A7, the battery's divider at A8. MPU6050 at 20 and 21.
#define TWI_DDR DDRD
#define TWI_PORT PORTD
#define TWI_SCL PD0
#define TWI_SDA PD1
#define TWI_SDA_HIGH (PIND & _BV(PD1))

#else
#error "no pins are known for this chip"
#endif

#endif
